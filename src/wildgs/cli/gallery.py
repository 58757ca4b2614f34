"""`wildgs gallery`: views times appearances at a glance: does light transfer, does geometry hold?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from PIL import Image

from wildgs.api import LoadedScene, load
from wildgs.cli.lights import LightOptions, find_looks
from wildgs.cli.progress import console, counting
from wildgs.cli.showcase import different_lights
from wildgs.errors import UserError
from wildgs.evaluation.pictures import picture_paths, write_picture
from wildgs.export.sheet import contact_sheet
from wildgs.files import written_aside
from wildgs.light.look import NEUTRAL, Look
from wildgs.light.sources import read_picture
from wildgs.scene import Scene, View, find_view, match_view

VIEWS, LIGHTS = 4, 5
TILE = 320
QUALITY = 92


@dataclass(frozen=True)
class Command:
    """Renders a grid of views (rows) and appearances (columns) as one picture, and each tile.

    Example: wildgs gallery runs/gate --appearance noon.jpg evening.jpg neutral --output gallery

    The first row shows the photos that lend their light, the first column those whose viewpoint is taken.
    """

    run: tyro.conf.Positional[Path]
    """Run folder."""
    output: Path | None = None
    """Folder: OUTPUT/gallery.jpg and OUTPUT/<appearance>/<view>.png. RUN/gallery without it."""
    view: tuple[str, ...] = ()
    """Photos whose viewpoint is rendered, by name; without any, a few that were held out."""
    light: Annotated[LightOptions, tyro.conf.arg(name="")] = field(
        default_factory=lambda: LightOptions(appearance=())
    )


def run(command: Command) -> None:
    """Renders all tiles and the sheet."""
    scene = load(command.run)
    views = [find_view(scene.scene, name) for name in command.view] or some_views(scene.scene)
    if not views:
        raise UserError(f"{scene.scene.root} has no photo to look through")
    specs = command.light.appearance or default_lights(scene)
    looks = find_looks(scene, command.light, specs)
    output = command.output or command.run / "gallery"
    tiles = render_tiles(scene, views, looks, output)
    # A mix of several photos has no photo to stand above it.
    sources = [source_picture(scene.scene, spec) for spec in specs] if len(looks) == len(specs) else []
    with written_aside(output / "gallery.jpg") as aside:
        draw_sheet(views, looks, tiles, sources).save(aside, "JPEG", quality=QUALITY)
    console.print(f"{len(views)} views x {len(looks)} appearances -> {output / 'gallery.jpg'}")


def draw_sheet(
    views: Sequence[View],
    looks: Sequence[Look],
    tiles: Sequence[Sequence[np.ndarray]],
    sources: Sequence[np.ndarray | None],
) -> Image.Image:
    """The grid: below the photos that lend their light, beside those whose viewpoint is taken."""
    rows: list[list[np.ndarray | None]] = []
    if any(source is not None for source in sources):
        rows.append([None, *sources])
    for view, row in zip(views, tiles, strict=True):
        rows.append([view.read_photo().numpy(), *row])
    camera = views[0].camera
    scale = min(1.0, TILE / max(camera.width, camera.height))
    tile = (round(camera.width * scale), round(camera.height * scale))
    return contact_sheet(rows, ["the view's photo", *(look.name for look in looks)], tile=tile)


def some_views(scene: Scene) -> list[View]:
    """A few held-out views, evenly spread; training views where none are held out."""
    views = scene.test_views or scene.train_views
    return list(views[:: max(1, -(-len(views) // VIEWS))][:VIEWS])


def default_lights(scene: LoadedScene) -> list[str]:
    """The mean light and a few photos as unlike each other as the collection allows."""
    if not scene.relightable:
        return [NEUTRAL]
    return [NEUTRAL, *(view.name for view in different_lights(scene.scene.train_views, LIGHTS))]


def render_tiles(
    scene: LoadedScene, views: Sequence[View], looks: Sequence[Look], output: Path
) -> list[list[np.ndarray]]:
    """Renders every view under every look; writes each as OUTPUT/<appearance>/<view>.png.

    Returns:
        Rows of views, columns of looks.
    """
    paths = picture_paths([view.name for view in views])
    folders = picture_paths([look.name for look in looks])
    rows = []
    with counting("rendering") as progress:
        for index, view in enumerate(views):
            row = []
            for number, look in enumerate(looks):
                picture = scene.render(view.camera, look)
                write_picture(output / folders[look.name].with_suffix("") / paths[view.name], picture)
                row.append(picture.numpy())
                progress(index * len(looks) + number + 1, len(views) * len(looks))
            rows.append(row)
    return rows


def source_picture(scene: Scene, spec: str) -> np.ndarray | None:
    """The picture that lends a look its light, where there is one."""
    view = match_view(scene.views, spec)
    if view is not None:
        return view.read_photo().numpy()
    file = Path(spec)
    if spec == NEUTRAL or file.suffix == ".safetensors" or not file.is_file():
        return None
    return read_picture(file).numpy()
