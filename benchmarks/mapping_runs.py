"""How much do runs of incremental mapping differ, with other seeds and other initial pairs? The first pass alone.

    python benchmarks/mapping_runs.py ../shared/data/longchamp/images --seeds 7 --pairs 9

A line for each run: photos with a pose, points, observations, the share of the verified matches that agree with the
poses (closer than a pixel of 500), and CPU time. Initial pairs are those of `wildgs.sfm.initial_pairs`, in its
order.
"""

from __future__ import annotations

import tempfile
import time
import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import tyro

import wildgs
from wildgs.errors import WildGSWarning
from wildgs.progress import Progress
from wildgs.sfm import passes
from wildgs.sfm.config import SfmConfig
from wildgs.sfm.initial_pairs import initial_pairs
from wildgs.sfm.lookalikes import count_agreeing
from wildgs.sfm.mapping import map_photos
from wildgs.sfm.upright import WorkingCopy
from wildgs.sfm.workplace import Workplace


@dataclass(frozen=True)
class Command:
    """Maps a folder of photos several times."""

    photos: tyro.conf.Positional[Path]
    """Folder of photos."""
    seeds: int = 3
    """Number of runs that start as COLMAP chooses, with seeds from 0 on."""
    pairs: int = 5
    """Number of runs that start with other initial pairs."""


class _EnoughError(Exception):
    """Ends structure from motion after the runs."""


def describe(models: Sequence[Any], work: Workplace) -> str:
    """A line about the largest model of a run."""
    if not models:
        return "no model"
    agreeing, matches = count_agreeing(models[0], work.database)
    return (
        f"{models[0].num_reg_images()} photos, {models[0].num_points3D()} points,"
        f" {models[0].compute_num_observations()} observations,"
        f" {agreeing / max(matches, 1):.3f} of {matches} matches agree"
    )


FirstPass = Callable[[Workplace, Sequence[WorkingCopy], SfmConfig, Progress], None]


def after_matching(photos: Path, first_pass: FirstPass, config: SfmConfig | None = None) -> None:
    """Matches a folder of photos, and calls a function in place of the first pass."""
    warnings.simplefilter("ignore", WildGSWarning)

    def call(work: Workplace, copies: Sequence[WorkingCopy], config: SfmConfig, progress: Progress) -> Any:
        first_pass(work, copies, config, progress)
        raise _EnoughError

    passes.map_repeatedly = call
    with tempfile.TemporaryDirectory() as folder, suppress(_EnoughError):
        wildgs.reconstruct(photos, Path(folder) / "scene", config)


def main(command: Command) -> None:
    """Prints the runs."""

    def runs(work: Workplace, copies: Sequence[WorkingCopy], config: SfmConfig, progress: Progress) -> None:
        for seed in range(command.seeds):
            begun = time.process_time()
            models = map_photos(work, len(copies), replace(config, seed=seed), progress)
            print(f"seed {seed}: {describe(models, work)}, {time.process_time() - begun:.1f} s", flush=True)
        for number, pair in enumerate(islice(initial_pairs(work.database), command.pairs), start=1):
            begun = time.process_time()
            models = map_photos(work, len(copies), config, progress, pair=pair)
            print(f"pair {number}: {describe(models, work)}, {time.process_time() - begun:.1f} s", flush=True)

    after_matching(command.photos, runs)


if __name__ == "__main__":
    main(tyro.cli(Command))
