"""`wildgs sfm`: from a folder of photos to a scene with camera poses."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import tyro

from wildgs.cli.screen import console, progress_shown
from wildgs.sfm.config import SfmConfig


@dataclass(frozen=True)
class Command:
    """Finds the cameras of a folder of photos (structure from motion) and writes a COLMAP scene.

    Photos that cannot be registered are named with the likely reason; the others are not affected. After an
    interruption, the same command continues.

    Example: wildgs sfm photos/gate --output scenes/gate
    """

    photos: tyro.conf.Positional[Path]
    """Folder of photos, sub-folders included."""
    output: Path
    """Scene folder to write."""
    overwrite: bool = False
    """Replace the scene of an earlier run."""
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
    console.print(f"scene in {command.output}")
