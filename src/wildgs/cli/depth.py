"""`wildgs depth`: the depth prior of a scene, by Depth Anything V2."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from wildgs.cli.screen import console, progress_shown
from wildgs.priors.config import DEPTH_ANYTHING


@dataclass(frozen=True)
class Command:
    """Estimates the disparity of every photo of a scene and writes it to SCENE/depth/ as 16-bit pictures.

    Training then uses it as its depth prior. Photos that already have an estimate are skipped.

    Example: wildgs depth scenes/gate
    """

    scene: tyro.conf.Positional[Path]
    """Folder of a COLMAP scene (images/ and sparse/0/)."""
    model: str = DEPTH_ANYTHING
    """Folder of the network in the hub's layout, or its name on the hub."""
    overwrite: bool = False
    """Estimate again what is already there."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where the network runs."""


def run(command: Command) -> None:
    """Fills the scene's depth folder."""
    import wildgs

    with progress_shown() as screen:
        done = wildgs.estimate_depth(
            command.scene,
            model=command.model,
            overwrite=command.overwrite,
            device=None if command.device == "auto" else command.device,
            progress=screen,
        )
    console.print(f"{done.folder}: {done.written} written, {done.kept} there before")
