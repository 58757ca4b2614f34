"""`wildgs depth`: the depth prior of a scene, by Depth Anything V2."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from wildgs.cli.progress import console, counting
from wildgs.errors import UserError
from wildgs.priors.depth import DEPTH_ANYTHING, fill_depth_folder, load_depth_anything


@dataclass(frozen=True)
class Command:
    """Estimates the disparity of every photo of a scene and writes it to SCENE/depth/ as 16-bit pictures.

    Training then uses it as its depth prior. Photos that already have a picture there are passed over.

    Example: wildgs depth scenes/gate
    """

    scene: tyro.conf.Positional[Path]
    """Folder of a COLMAP scene (images/ and sparse/0/)."""
    model: str = DEPTH_ANYTHING
    """Folder of the network in the hub's layout, or its name on the hub."""
    overwrite: bool = False
    """Estimate anew what is already there."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where the network runs."""


def run(command: Command) -> None:
    """Fills the scene's depth folder."""
    if not command.scene.is_dir():
        raise UserError(f"{command.scene}: no such folder; give the folder of a COLMAP scene")
    device = None if command.device == "auto" else command.device
    estimator = load_depth_anything(command.model, device=device, required=True)
    assert estimator is not None  # `required` raises otherwise
    with counting("estimating depth") as progress:
        written, kept = fill_depth_folder(
            command.scene, estimator, overwrite=command.overwrite, progress=progress
        )
    console.print(f"{command.scene / 'depth'}: {written} written, {kept} there before")
