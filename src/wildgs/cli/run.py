"""`wildgs run`: from a folder of photos to a scored scene in one command."""

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
    """Estimates camera poses for a folder of photos, trains, scores and writes web pages.

    Default number of steps and image size: 30,000 steps on photos of up to 1,600 pixels on a GPU, 3,000 steps on
    photos of up to 400 pixels on a CPU. After an interruption, run the same command again to continue.

    Example: wildgs run photos/sacre_coeur --output runs/sacre_coeur
    """

    photos: tyro.conf.Positional[Path]
    """Folder of photos."""
    output: Path
    """Run folder; the scene with camera poses is written to OUTPUT/scene."""
    steps: int | None = None
    """Training steps."""
    max_side: int | None = None
    """Longest side of a photo in pixels; larger photos are reduced to it, smaller ones are not changed."""
    downscale: float | None = None
    """Factor by which the photos' width and height are divided, before --max-side. If it is given without
    --max-side, photos are not reduced further."""
    max_gaussians: int | None = None
    """Upper bound on the number of Gaussians. Default: depends on the machine's memory."""
    holdout: int | None = None
    """Hold out every n-th photo for scoring; 0 = none. Default: 8."""
    sfm: tyro.conf.OmitArgPrefixes[SfmConfig] = field(default_factory=SfmConfig)
    image_cache: str = IMAGE_CACHE
    """Memory for decoded photos; photos that do not fit are decoded again at every use."""


def run(command: Command) -> None:
    """Runs every stage that is not finished yet."""
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
