"""`wildgs sfm`: estimates camera poses for a folder of photos."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import tyro

from wildgs.cli.screen import console, progress_shown
from wildgs.sfm.config import SfmConfig


@dataclass(frozen=True)
class Command:
    """Estimates the cameras of a folder of photos by structure from motion and writes a COLMAP scene.

    Photos that cannot be registered are listed with the likely reason. After an interruption, run the same command
    again to continue.

    Example: wildgs sfm photos/gate --output scenes/gate
    """

    photos: tyro.conf.Positional[Path]
    """Folder of photos, searched with its sub-folders."""
    output: Path
    """Scene folder to write."""
    overwrite: bool = False
    """Replace an existing scene."""
    sfm: tyro.conf.OmitArgPrefixes[SfmConfig] = field(default_factory=SfmConfig)


def run(command: Command) -> None:
    """Reconstructs and prints the report."""
    import wildgs

    with progress_shown() as screen:
        report = wildgs.reconstruct(
            command.photos, command.output, command.sfm, overwrite=command.overwrite, progress=screen
        )
    for line in report.lines():
        console.print(line)
    console.print(f"scene written to {command.output}")
