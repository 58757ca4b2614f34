"""`wildgs.gallery`: renders a grid of views and appearances as one contact sheet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageDraw, ImageFont

from wildgs.errors import UserError
from wildgs.exporters.outputs import names_file
from wildgs.files import is_file, written_aside
from wildgs.library.config import MixOptions
from wildgs.library.loaded import LoadedScene, Spec, find_looks, folder_of, loaded, without_repeats
from wildgs.library.pages import different_lights
from wildgs.library.rendering import find_views, render_each
from wildgs.light.look import NEUTRAL, Look
from wildgs.light.saved import SUFFIX
from wildgs.light.sources import read_picture
from wildgs.progress import Progress
from wildgs.scene import Scene, match_view

VIEWS, LIGHTS = 4, 5
TILE = 320
QUALITY = 92
GAP = 6
PAPER, INK = (255, 255, 255), (40, 40, 40)
Picture = UInt8[np.ndarray, "_ _ 3"]
FORMATS = {".jpg": "JPEG", ".jpeg": "JPEG", ".png": "PNG"}


@dataclass(frozen=True)
class WrittenGallery:
    """A written gallery.

    Attributes:
        sheet: The image with all tiles.
        tiles: Folder of the single tiles, <appearance>/<view>.png; None if `output` was an image file.
        views: Names of the photos of the rows.
        looks: Appearances of the columns.
    """

    sheet: Path
    tiles: Path | None
    views: tuple[str, ...]
    looks: tuple[Look, ...]


def gallery(
    run: str | Path | LoadedScene,
    output: str | Path | None = None,
    *,
    views: Sequence[str] = (),
    appearance: Spec | Sequence[Spec] = (),
    mixing: MixOptions | None = None,
    progress: Progress | None = None,
) -> WrittenGallery:
    """Renders a grid of views (rows) and appearances (columns) as one image.

    Args:
        run: A run folder, or a loaded scene.
        output: An image file (.jpg, .png), or a folder for gallery.jpg and every tile. Default: RUN/gallery.
        views: Names of the photos whose viewpoints are rendered. Default: a few held-out photos.
        appearance: Anything that `LoadedScene.appearance` accepts. Default: neutral and a few photos.
        mixing: How appearances are obtained and mixed.
        progress: Called for every tile.

    Raises:
        UserError: A view or an appearance does not exist, or the output cannot be written.
    """
    scene = loaded(run)
    held_out = scene.scene.test_views or scene.scene.train_views
    output = folder_of(run) / "gallery" if output is None else Path(output)
    single = names_file(output, tuple(FORMATS))
    rows = find_views(scene.scene, views) or held_out[:: max(1, -(-len(held_out) // VIEWS))]
    if not rows:
        raise UserError(f"{scene.scene.root} has no photo with a camera")
    specs = without_repeats(scene, appearance, mixing) or _default_lights(scene)
    looks = find_looks(scene, specs, mixing, progress=progress)
    sheet, folder = (output, None) if single else (output / "gallery.jpg", output)
    tiles = [picture.numpy() for picture in render_each(scene, rows, looks, folder, progress=progress)]
    grid: list[list[Picture | None]] = [
        [view.read_photo().numpy(), *tiles[number * len(looks) :][: len(looks)]]
        for number, view in enumerate(rows)
    ]
    # A mix of several photos has no single photo to show above its column.
    sources = [_source(scene.scene, spec) for spec in specs] if len(looks) == len(specs) else []
    if any(source is not None for source in sources):
        grid.insert(0, [None, *sources])
    camera = rows[0].camera
    scale = min(1.0, TILE / max(camera.width, camera.height))
    tile = (round(camera.width * scale), round(camera.height * scale))
    picture = contact_sheet(grid, ["the view's photo", *(look.name for look in looks)], tile=tile)
    with written_aside(sheet) as aside:
        picture.save(aside, FORMATS[sheet.suffix.lower()], quality=QUALITY)
    return WrittenGallery(sheet, folder, tuple(view.name for view in rows), tuple(looks))


def _default_lights(scene: LoadedScene) -> list[str]:
    """Neutral, and a few photos of very different light."""
    if not scene.relightable:
        return [NEUTRAL]
    return [NEUTRAL, *(view.name for view in different_lights(scene.scene.train_views, LIGHTS))]


def _source(scene: Scene, spec: Spec) -> np.ndarray | None:
    """The image of which an appearance is the embedding, if there is one."""
    spec = spec.name if isinstance(spec, Look) else str(spec)
    if spec == NEUTRAL or spec.endswith(SUFFIX):
        return None
    view = match_view(scene.views, spec)
    if view is not None:
        return view.read_photo().numpy()
    file = Path(spec)
    if not is_file(file):
        return None
    return read_picture(file).numpy()


def fit(picture: Picture, width: int, height: int) -> Image.Image:
    """Fits an image into a tile and pads it if the aspect ratio differs."""
    image = Image.fromarray(picture)
    scale = min(width / image.width, height / image.height)
    size = (max(1, round(image.width * scale)), max(1, round(image.height * scale)))
    tile = Image.new("RGB", (width, height), PAPER)
    tile.paste(
        image.resize(size, Image.Resampling.LANCZOS), ((width - size[0]) // 2, (height - size[1]) // 2)
    )
    return tile


def contact_sheet(
    rows: Sequence[Sequence[Picture | None]],
    captions: Sequence[str],
    *,
    tile: tuple[int, int],
) -> Image.Image:
    """Arranges images in rows and columns, with a caption above each column.

    Args:
        rows: Images, None for an empty tile; all rows have the same length.
        captions: Captions of the columns.
        tile: Width and height of a tile in pixels; images keep their aspect ratio.
    """
    width, height = tile
    letters = max(10, round(height * 0.075))
    font = ImageFont.load_default(size=letters)
    above = round(1.6 * letters)
    sheet = Image.new(
        "RGB",
        (len(captions) * (width + GAP) + GAP, above + len(rows) * (height + GAP) + GAP),
        PAPER,
    )
    draw = ImageDraw.Draw(sheet)
    for column, caption in enumerate(captions):
        left = GAP + column * (width + GAP)
        words = shorten(caption, font, width)
        draw.text((left, above / 2 + GAP / 2), words, fill=INK, font=font, anchor="lm")
        for row, pictures in enumerate(rows):
            picture = pictures[column]
            if picture is not None:
                sheet.paste(fit(picture, width, height), (left, above + GAP + row * (height + GAP)))
    return sheet


def shorten(words: str, font: ImageFont.FreeTypeFont | ImageFont.ImageFont, width: int) -> str:
    """Shortens a caption to a width in pixels by an ellipsis in its middle."""
    if font.getlength(words) <= width:
        return words
    for kept in range(len(words) - 1, 1, -1):
        head, tail = words[: -(-kept // 2)], words[len(words) - kept // 2 :]
        if font.getlength(f"{head}…{tail}") <= width:
            return f"{head}…{tail}"
    return ""
