"""Images of the matches of photos without a pose, for the report of a run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from PIL import Image, ImageDraw

from wildgs.sfm.database import open_database
from wildgs.sfm.matching import image_ids
from wildgs.sfm.placement import Failure
from wildgs.sfm.upright import WorkingCopy
from wildgs.sfm.workplace import Workplace

FOLDER = "matches"
"""Folder of the images in the scene folder."""
MAX_PICTURES = 40
SIDE = 320
"""Longer side, in pixels, of each of the two photos in an image."""
COLORS = ((230, 60, 60), (60, 200, 80), (70, 140, 255), (240, 200, 40), (220, 80, 220))


def write_match_pictures(
    work: Workplace, copies: Sequence[WorkingCopy], failures: Mapping[str, Failure]
) -> dict[str, str]:
    """Draws each photo without a pose beside the photo that it matches best, with their verified matches.

    Returns:
        The files, relative to the scene folder, by photo name; photos without matches have none.
    """
    rows = {copy.name: row for row, copy in enumerate(copies)}
    pictures = {}
    with open_database(work.database) as database:
        ids = image_ids(database, copies)
        for name, failure in failures.items():
            if failure.partner is None or len(pictures) == MAX_PICTURES:
                continue
            pair = rows[name], rows[failure.partner]
            first, second = (ids[row] for row in pair)
            if first is None or second is None:
                continue
            matches = database.read_two_view_geometry(first, second).inlier_matches
            places = [
                database.read_keypoints(image)[matches[:, side], :2].astype(np.float64)
                for side, image in enumerate((first, second))
            ]
            photos = []
            for row in pair:
                with Image.open(work.images / copies[row].work_name) as photo:
                    photos.append(photo.convert("RGB"))
            file = Path(FOLDER) / f"{len(pictures):03d}.jpg"
            (work.scene / FOLDER).mkdir(exist_ok=True)
            draw_matches(photos, places).save(work.scene / file, quality=85)
            pictures[name] = file.as_posix()
    return pictures


def draw_matches(photos: Sequence[Image.Image], places: Sequence[Float[np.ndarray, "M 2"]]) -> Image.Image:
    """Draws two photos side by side with a line for each match."""
    small = [photo.copy() for photo in photos]
    for photo in small:
        photo.thumbnail((SIDE, SIDE))
    left = small[0].width
    picture = Image.new("RGB", (left + small[1].width, max(photo.height for photo in small)), "white")
    picture.paste(small[0], (0, 0))
    picture.paste(small[1], (left, 0))
    draw = ImageDraw.Draw(picture)
    scales = [after.width / before.width for after, before in zip(small, photos, strict=True)]
    ends = zip(places[0] * scales[0], places[1] * scales[1] + [left, 0], strict=True)
    for number, (start, end) in enumerate(ends):
        draw.line([*start.tolist(), *end.tolist()], fill=COLORS[number % len(COLORS)])
    return picture
