"""How much faster is the first pass of structure from motion in processes of its own?

    python benchmarks/mapping_ahead.py ../shared/data/longchamp/images

Matches the photos once, and maps them in this process and in others, in turns. Prints times and their ratio, and
what both found.
"""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import tyro

from benchmarks.mapping_runs import after_matching, describe
from wildgs.progress import Progress
from wildgs.sfm import mapping_ahead
from wildgs.sfm.config import SfmConfig
from wildgs.sfm.repeated_mapping import map_repeatedly
from wildgs.sfm.upright import WorkingCopy
from wildgs.sfm.workplace import Workplace


@dataclass(frozen=True)
class Command:
    """Times the first pass."""

    photos: tyro.conf.Positional[Path]
    """Folder of photos."""
    turns: int = 1
    """Number of times that both are timed."""
    threads: int = os.cpu_count() or 1
    """Number of threads."""


def main(command: Command) -> None:
    """Prints the times."""

    def both(work: Workplace, copies: Sequence[WorkingCopy], config: SfmConfig, progress: Progress) -> None:
        usual, ratios = mapping_ahead.LEAST_PHOTOS, []
        for _ in range(command.turns):
            seconds: list[float] = []
            for name, least in (("in this process", len(copies) + 1), ("in processes", usual)):
                mapping_ahead.LEAST_PHOTOS = least
                begun = time.perf_counter()
                models: list[Any] = map_repeatedly(work, copies, config, progress)
                seconds.append(time.perf_counter() - begun)
                print(f"{name}: {seconds[-1]:.1f} s, {describe(models, work)}", flush=True)
            ratios.append(seconds[0] / seconds[1])
        print(f"{median(ratios):.2f} times as fast")

    after_matching(command.photos, both, SfmConfig(threads=command.threads))


if __name__ == "__main__":
    main(tyro.cli(Command))
