"""`wildgs run`: a folder of photos becomes a scored scene, in one command."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from wildgs.cli.options import UNNAMED
from wildgs.cli.screen import print_finished, progress_shown
from wildgs.config import ExecutionConfig
from wildgs.sfm.config import SfmConfig

SHOWN = ("steps", "downscale", "max_gaussians", "holdout", "execution.image_cache")


@dataclass(frozen=True)
class Command:
    """Poses, trains, scores and shows a folder of photos.

    Steps and size follow the machine unless given: 30,000 steps on photos of up to 1,600 pixels on a GPU, 3,000
    steps on photos of up to 400 pixels on a CPU.

    Example: wildgs run photos/sacre_coeur --output runs/sacre_coeur
    """

    photos: tyro.conf.Positional[Path]
    """Folder of photos."""
    output: Path
    """Run folder; the posed scene goes to OUTPUT/scene."""
    steps: int | None = None
    """Training steps."""
    downscale: float | None = None
    """Divides the photos' width and height."""
    max_gaussians: int | None = None
    """Upper bound on the number of Gaussians; by default it follows the machine."""
    holdout: int = 8
    """Every n-th photo is held out for scoring; 0 = none."""
    sfm: tyro.conf.OmitArgPrefixes[SfmConfig] = field(default_factory=SfmConfig)
    execution: Annotated[ExecutionConfig, UNNAMED] = field(default_factory=ExecutionConfig)


def run(command: Command) -> None:
    """Runs every stage; a stage that is done already is not done again."""
    import wildgs

    with progress_shown() as screen:
        finished = wildgs.run(
            command.photos,
            command.output,
            steps=command.steps,
            downscale=command.downscale,
            max_gaussians=command.max_gaussians,
            holdout=command.holdout,
            sfm=command.sfm,
            execution=command.execution,
            progress=screen,
            observers=[screen.step],
        )
    print_finished(finished)
