"""`wildgs depth`: the depth of a scene's photos, by a network or by multi-view stereo."""

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
    """Estimates the depth of the photos of a scene and writes it to SCENE/depth/, where training finds it.

    Depth Anything V2 (network) gives the disparity of every photo, of unknown scale, as 16-bit pictures. Multi-view
    stereo needs no network: it compares training photos with each other and gives metric depth (.tiff, 32-bit
    floats in units of the COLMAP model) where three of them agree. Training uses both where both exist. Photos that
    already have an estimate are skipped.

    Example: wildgs depth scenes/gate --by stereo
    """

    scene: tyro.conf.Positional[Path]
    """Folder of a COLMAP scene (images/ and sparse/0/)."""
    by: Literal["network", "stereo"] = "network"
    """What estimates depth."""
    model: str = DEPTH_ANYTHING
    """Folder of the network in the hub's layout, or its name on the hub."""
    overwrite: bool = False
    """Estimate again what is already there."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where the network runs."""
    holdout: int = DataConfig.holdout
    """Stereo leaves out every n-th photo where the scene has no .tsv split; as --data.holdout of `wildgs train`."""
    stereo: StereoConfig = field(default_factory=StereoConfig)
    """Options of stereo."""


def run(command: Command) -> None:
    """Fills the scene's depth folder."""
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
    console.print(f"{done.folder}: {done.written} written, {done.kept} there before")
