"""`wildgs gallery`: renders a grid of views and appearances as one image."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from wildgs.cli.options import UNNAMED, LightOptions
from wildgs.cli.screen import console, print_notes, progress_shown


@dataclass(frozen=True)
class Command:
    """Renders a grid of views (rows) and appearances (columns) as one image.

    The first row shows the photos of the appearances, the first column the photos of the views.

    Example: wildgs gallery runs/gate --appearance noon.jpg evening.jpg neutral --output gallery
    """

    run: tyro.conf.Positional[Path]
    """Run folder."""
    output: Path | None = None
    """An image file (.jpg, .png), or a folder for gallery.jpg and <appearance>/<view>.png. Default: RUN/gallery."""
    view: tuple[str, ...] = ()
    """Names of the photos whose viewpoints are rendered. Default: a few held-out photos."""
    light: Annotated[LightOptions, UNNAMED] = field(default_factory=lambda: LightOptions(appearance=()))


def run(command: Command) -> None:
    """Renders the grid."""
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
