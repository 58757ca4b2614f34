"""`wildgs eval`: scores of a run on the photos that were held out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from wildgs.cli.screen import print_scores, progress_shown


@dataclass(frozen=True)
class Command:
    """Scores a run's held-out views and writes them to RUN/eval/.

    `full` takes a view's light from the whole photo and scores the whole frame; `half` takes it from the left
    half and scores the right one.

    Example: wildgs eval runs/gate --protocol half
    """

    run: tyro.conf.Positional[Path]
    """Run folder."""
    protocol: Literal["full", "half", "both"] = "both"
    """Where the light comes from and what is scored."""
    scene: Path | None = None
    """The scene folder, where it is not where it was when the run was trained."""
    lpips: Path | None = None
    """Folder with other LPIPS weights (AlexNet's, say) than the package's SqueezeNet."""


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
