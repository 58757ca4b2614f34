"""`wildgs export`: writes files for other programs, or a relightable web page."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from wildgs.cli.options import UNNAMED, Mix
from wildgs.cli.screen import console, print_notes, progress_shown
from wildgs.exporters.config import CleanupConfig
from wildgs.library.config import ExportFormat, MixOptions


@dataclass(frozen=True)
class Command:
    """Exports a run to files for other programs.

    html (a web page that opens from disk, without server or network), glb (glTF) and usd (OpenUSD) hold all
    appearances in one file. Other formats get one file per appearance. Coordinates are those of the COLMAP model.

    Example: wildgs export runs/gate --format html --appearance evening.jpg noon.jpg night.jpg
    """

    run: tyro.conf.Positional[Path]
    """Run folder."""
    format: tuple[ExportFormat, ...] = ("html",)
    """One or more file formats."""
    appearance: tuple[str, ...] = ()
    """Names of photos of the scene, files of new photos or any images, saved appearances, or neutral. Default:
    several photos of very different light for html, glb and usd; neutral for the others."""
    mix: Mix = field(default_factory=MixOptions)
    output: Path | None = None
    """Folder for the files, or the file itself if only one is written. Default: RUN/export."""
    title: str | None = None
    """Title of html, glb and usd. Default: the run folder's name."""
    aligned: bool = False
    """Use the frame of training (+z up, median depth of the photos = 1) instead of the COLMAP model's."""
    spz_version: Literal[3, 4] = 4
    """Version of the spz format; choose 3 for programs that do not support 4 yet."""
    cleanup: Annotated[CleanupConfig, UNNAMED] = field(default_factory=CleanupConfig)


def run(command: Command) -> None:
    """Writes the files and prints their size and content."""
    import wildgs

    with progress_shown() as screen:
        written = wildgs.export(
            command.run,
            command.format,
            appearance=command.appearance,
            output=command.output,
            title=command.title,
            aligned=command.aligned,
            cleanup=command.cleanup,
            spz_version=command.spz_version,
            mixing=command.mix,
            progress=screen,
        )
    print_notes({look: None for file in written for look in file.looks})
    for file in written:
        size = f"{file.file}: {file.megabytes:.1f} MB, {file.num_gaussians:,} Gaussians"
        if file.file.suffix.lower() in (".html", ".glb", ".usd"):
            lights = f"{len(file.looks)} lights" if len(file.looks) > 1 else "1 light"
            hint = "; open it in a browser" if file.file.suffix.lower() == ".html" else ""
            console.print(f"{size}, {lights}, harmonics of degree {file.sh_degree}{hint}")
        else:
            console.print(f"{size} under {file.looks[0].name}")
