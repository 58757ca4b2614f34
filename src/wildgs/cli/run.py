"""`wildgs run`: a folder of photos becomes a scored scene, in one command."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import tyro

from wildgs.cli.screen import print_finished, progress_shown
from wildgs.config import ExecutionConfig
from wildgs.scene.config import IMAGE_CACHE
from wildgs.sfm.config import SfmConfig

SHOWN = ("steps", "max_side", "downscale", "max_gaussians", "holdout", "image_cache")


@dataclass(frozen=True)
class Command:
    """Poses, trains, scores and shows a folder of photos.

    Steps and size follow the machine unless given: 30,000 steps on photos of up to 1,600 pixels on a GPU, 3,000
    steps on photos of up to 400 pixels on a CPU. The same command continues where it was interrupted.

    Example: wildgs run photos/sacre_coeur --output runs/sacre_coeur
    """

    photos: tyro.conf.Positional[Path]
    """Folder of photos."""
    output: Path
    """Run folder; the posed scene goes to OUTPUT/scene."""
    steps: int | None = None
    """Training steps."""
    max_side: int | None = None
    """Reduces each photo so that its own longer side is at most this many pixels; smaller ones stay as they are."""
    downscale: float | None = None
    """Divides the photos' width and height, before --max-side; without --max-side the only reduction."""
    max_gaussians: int | None = None
    """Upper bound on the number of Gaussians; by default it follows the machine."""
    holdout: int | None = None
    """Every n-th photo is held out for scoring; 0 = none. (default: 8)"""
    sfm: tyro.conf.OmitArgPrefixes[SfmConfig] = field(default_factory=SfmConfig)
    image_cache: str = IMAGE_CACHE
    """Memory for decoded photos; photos beyond it are decoded again when their turn comes."""


def run(command: Command) -> None:
    """Runs every stage; a stage that is done already is not done again."""
    import wildgs

    threads = command.sfm.threads if command.sfm.threads > 0 else None
    execution = ExecutionConfig(image_cache=command.image_cache, threads=threads)
    with progress_shown() as screen:
        finished = wildgs.run(
            command.photos,
            command.output,
            steps=command.steps,
            max_side=command.max_side,
            downscale=command.downscale,
            max_gaussians=command.max_gaussians,
            holdout=command.holdout,
            sfm=command.sfm,
            execution=execution,
            progress=screen,
            observers=[screen.step],
        )
    print_finished(finished)
