"""`wildgs sfm`: from a folder of photos to a scene with camera poses."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import tyro

from wildgs.cli.progress import console, stages
from wildgs.sfm.reconstruction import SfmConfig, SfmReport, reconstruct


@dataclass(frozen=True)
class Command:
    """Finds the cameras of a folder of photos (structure from motion) and writes a COLMAP scene.

    Photos that cannot be registered are named with the likely reason; the others are not affected.

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
    report = reconstruct_with_progress(
        command.photos, command.output, command.sfm, overwrite=command.overwrite
    )
    print_report(report)
    console.print(f"scene in {command.output}", markup=False)


def reconstruct_with_progress(
    photos: Path, output: Path, config: SfmConfig, *, overwrite: bool = False
) -> SfmReport:
    """`reconstruct` with a bar, or a line, for each of its steps."""
    with stages() as show:
        return reconstruct(photos, output, config, overwrite=overwrite, progress=show)


def print_report(report: SfmReport) -> None:
    """Prints how many photos were registered, and why the others were not."""
    for line in report.lines():
        console.print(line, markup=False)
