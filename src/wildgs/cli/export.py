"""`wildgs export`: files for other programs, and the web page that carries the light."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from wildgs.cli.options import UNNAMED, Mix
from wildgs.cli.screen import console, print_notes, progress_shown
from wildgs.exporters.config import CleanupConfig
from wildgs.library.config import ExportFormat, MixOptions


@dataclass(frozen=True)
class Command:
    """Writes a run as files for other programs, one for each appearance, or as one web page with all of them.

    The page opens from disk without server or network. Other files hold the scene under one light, in the frame
    and scale of the photos' reconstruction.

    Example: wildgs export runs/gate --format html --appearance evening.jpg noon.jpg night.jpg
    """

    run: tyro.conf.Positional[Path]
    """Run folder."""
    format: tuple[ExportFormat, ...] = ("html",)
    """One or several of html, ply, compressed.ply, splat, spz, sog."""
    appearance: tuple[str, ...] = ()
    """Photos of the scene by name, files of new photos or any pictures, saved appearances, or neutral. By default
    the page takes four photos as different as the scene has them, and other files are neutral."""
    mix: Mix = field(default_factory=MixOptions)
    output: Path | None = None
    """Folder for the files; by default RUN/export. With one file to write, it may be the file itself."""
    title: str | None = None
    """The page's headline; by default the run folder's name."""
    aligned: bool = False
    """Keep the frame of training (+z up, the photos' median depth is 1) instead of the input's."""
    cleanup: Annotated[CleanupConfig, UNNAMED] = field(default_factory=CleanupConfig)


def run(command: Command) -> None:
    """Writes every file, and says what is in it."""
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
            mixing=command.mix,
            progress=screen,
        )
    print_notes({look: None for file in written for look in file.looks})
    for file in written:
        size = f"{file.file}: {file.megabytes:.1f} MB, {file.num_gaussians:,} Gaussians"
        if file.file.suffix == ".html":
            lights = f"{len(file.looks)} lights" if len(file.looks) > 1 else "1 light"
            console.print(f"{size}, {lights}, harmonics of degree {file.sh_degree}; open it in a browser")
        else:
            console.print(f"{size} under {file.looks[0].name}")
