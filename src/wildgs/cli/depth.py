"""`wildgs depth`: estimates depth maps of a scene's photos by a network or by multi-view stereo."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import tyro

from wildgs.cli.screen import console, progress_shown
from wildgs.priors.config import DEPTH_ANYTHING, StereoConfig
from wildgs.scene.config import DataConfig


@dataclass(frozen=True)
class Command:
    """Estimates depth maps for the photos of a scene and writes them to SCENE/depth/, where training reads them.

    `--by network` uses Depth Anything V2 and writes each photo's disparity, of unknown scale, as a 16-bit PNG.
    `--by stereo` matches training photos with each other and writes metric depth (.tiff, 32-bit floats in units of
    the COLMAP model) where at least three photos agree. Training can use both. Photos that already have a depth map
    are skipped.

    Example: wildgs depth scenes/gate --by stereo
    """

    scene: tyro.conf.Positional[Path]
    """Folder of a COLMAP scene (images/ and sparse/0/)."""
    by: Literal["network", "stereo"] = "network"
    """Depth estimator: Depth Anything V2, or multi-view stereo."""
    model: str = DEPTH_ANYTHING
    """Name of the network on the Hugging Face hub, or its folder in the hub's layout."""
    overwrite: bool = False
    """Replace existing depth maps."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Device of the network."""
    holdout: int = DataConfig.holdout
    """For stereo: skip every n-th photo if the scene has no .tsv split, as --holdout of `wildgs train`."""
    stereo: StereoConfig = field(default_factory=StereoConfig)
    """Options of stereo."""


def run(command: Command) -> None:
    """Writes the depth maps."""
    import wildgs

    with progress_shown() as screen:
        done = wildgs.estimate_depth(
            command.scene,
            by=command.by,
            model=command.model,
            stereo=command.stereo,
            holdout=command.holdout,
            overwrite=command.overwrite,
            device=None if command.device == "auto" else command.device,
            progress=screen,
        )
    console.print(f"{done.folder}: {done.written} written, {done.kept} already existed")
