"""`wildgs eval`: scores a run on its held-out photos."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from wildgs.cli.screen import print_scores, progress_shown


@dataclass(frozen=True)
class Command:
    """Scores a run on its held-out photos and writes the scores to RUN/eval/.

    The protocol `full` embeds the whole photo and scores the whole image; `half` embeds the left half of the photo
    and scores the right half.

    Example: wildgs eval runs/gate --protocol half
    """

    run: tyro.conf.Positional[Path]
    """Run folder."""
    protocol: Literal["full", "half", "both"] = "both"
    """Evaluation protocol."""
    scene: Path | None = None
    """Scene folder, if it has moved since training."""
    lpips: Path | None = None
    """Folder with other LPIPS weights, for example AlexNet's, than the package's SqueezeNet."""


def run(command: Command) -> None:
    """Scores and prints a table."""
    import wildgs

    with progress_shown() as screen:
        scores = wildgs.evaluate(
            command.run,
            ("full", "half") if command.protocol == "both" else (command.protocol,),
            scene=command.scene,
            lpips=command.lpips,
            progress=screen,
        )
    print_scores({str(command.run): scores})
