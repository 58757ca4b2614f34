"""Contact sheets: every picture in its place, whole; captions fit."""

from __future__ import annotations

import numpy as np
from PIL import ImageFont

from wildgs.library.gallery import GAP, PAPER, contact_sheet, fit, shorten


def flat(width: int, height: int, color: tuple[int, int, int]) -> np.ndarray:
    return np.full((height, width, 3), color, dtype=np.uint8)


def test_pictures_stand_in_rows_and_columns() -> None:
    red, green, blue = flat(40, 30, (200, 0, 0)), flat(40, 30, (0, 200, 0)), flat(40, 30, (0, 0, 200))
    sheet = np.asarray(contact_sheet([[None, red], [green, blue]], ["a", "b"], tile=(40, 30)))
    above = sheet.shape[0] - 2 * (30 + GAP) - GAP
    centres = [
        [
            tuple(sheet[above + GAP + row * (30 + GAP) + 15, GAP + column * (40 + GAP) + 20])
            for column in (0, 1)
        ]
        for row in (0, 1)
    ]
    assert centres == [[PAPER, (200, 0, 0)], [(0, 200, 0), (0, 0, 200)]]


def test_a_picture_of_another_shape_is_shown_whole_and_not_stretched() -> None:
    tall = flat(10, 40, (0, 0, 0))
    tile = np.asarray(fit(tall, 40, 20))
    dark = (tile < 128).all(axis=2)
    assert dark.any(axis=1).sum() == 20
    assert dark.any(axis=0).sum() == 5


def test_long_captions_are_cut_in_the_middle() -> None:
    font = ImageFont.load_default(size=12)
    words = "a very long name of a photo, number 0042.jpg"
    short = shorten(words, font, 100)
    assert font.getlength(short) <= 100
    assert short.startswith("a ve")
    assert short.endswith(".jpg")
    assert shorten("short", font, 100) == "short"
