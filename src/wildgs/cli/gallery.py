"""`wildgs gallery`: views times appearances of a run as one picture."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from wildgs.cli.options import UNNAMED, LightOptions
from wildgs.cli.screen import console, print_notes, progress_shown


@dataclass(frozen=True)
class Command:
    """Renders a grid of views (rows) and appearances (columns) as one picture, and each tile.

    Example: wildgs gallery runs/gate --appearance noon.jpg evening.jpg neutral --output gallery

    The first row shows the photos that lend their light, the first column those whose viewpoint is taken.
    """

    run: tyro.conf.Positional[Path]
    """Run folder."""
    output: Path | None = None
    """A picture (.jpg, .png), or a folder: OUTPUT/gallery.jpg and OUTPUT/<appearance>/<view>.png. By default the
    folder RUN/gallery."""
    view: tuple[str, ...] = ()
    """Photos whose viewpoint is rendered, by name. By default a few that were held out."""
    light: Annotated[LightOptions, UNNAMED] = field(default_factory=lambda: LightOptions(appearance=()))


def run(command: Command) -> None:
    """Renders all tiles and the sheet."""
    import wildgs

    with progress_shown() as screen:
        written = wildgs.gallery(
            command.run,
            command.output,
            views=command.view,
            appearance=command.light.appearance,
            mixing=command.light.mixing,
            progress=screen,
        )
    print_notes(written.looks)
    console.print(f"{len(written.views)} views x {len(written.looks)} appearances -> {written.sheet}")
