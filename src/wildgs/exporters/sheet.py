"""Contact sheets: a grid of pictures with captions, as one picture."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageDraw, ImageFont

GAP = 6
PAPER, INK = (255, 255, 255), (40, 40, 40)

Picture = UInt8[np.ndarray, "_ _ 3"]


def fit(picture: Picture, width: int, height: int) -> Image.Image:
    """Fits a picture into a tile, padded where its aspect ratio differs."""
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
    """Pictures in rows and columns, with a caption above each column.

    Args:
        rows: Pictures, None for an empty tile; all rows of one length.
        captions: Captions of the columns.
        tile: Width and height of a tile in pixels; the aspect ratio of pictures is kept.
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
