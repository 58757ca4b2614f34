"""`wildgs export`: files for other programs, and the web page that carries the light."""

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
    """Writes a run as files for other programs.

    html (a page that opens from disk, without server or network), glb (glTF) and usd (OpenUSD) hold all appearances
    in one file. The others are written once for each appearance, in the frame and scale of the reconstruction.

    Example: wildgs export runs/gate --format html --appearance evening.jpg noon.jpg night.jpg
    """

    run: tyro.conf.Positional[Path]
    """Run folder."""
    format: tuple[ExportFormat, ...] = ("html",)
    """One or several of html, glb, usd, ply, compressed.ply, splat, spz, sog."""
    appearance: tuple[str, ...] = ()
    """Photos of the scene by name, files of new photos or any pictures, saved appearances, or neutral. By default
    html, glb and usd take photos as different as the scene has them, and other files are neutral."""
    mix: Mix = field(default_factory=MixOptions)
    output: Path | None = None
    """Folder for the files; by default RUN/export. With one file to write, it may be the file itself."""
    title: str | None = None
    """The page's headline; by default the run folder's name."""
    aligned: bool = False
    """Keep the frame of training (+z up, the photos' median depth is 1) instead of the input's."""
    spz_version: Literal[3, 4] = 4
    """Of spz: 4, or 3 for programs that do not know 4 yet."""
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
            spz_version=command.spz_version,
            mixing=command.mix,
            progress=screen,
        )
    print_notes({look: None for file in written for look in file.looks})
    for file in written:
        size = f"{file.file}: {file.megabytes:.1f} MB, {file.num_gaussians:,} Gaussians"
        if file.file.suffix in (".html", ".glb", ".usd"):
            lights = f"{len(file.looks)} lights" if len(file.looks) > 1 else "1 light"
            hint = "; open it in a browser" if file.file.suffix == ".html" else ""
            console.print(f"{size}, {lights}, harmonics of degree {file.sh_degree}{hint}")
        else:
            console.print(f"{size} under {file.looks[0].name}")
