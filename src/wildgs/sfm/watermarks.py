"""Removes matches of captions and watermarks, which relate the margins of photos and not what they show.

Agencies print a caption or a banner in the margin of each photo. Photos that show different places match there, and
a model built on such matches registers them at one place. COLMAP's filter of stationary matches finds them if
both photos have the same size, because it compares pixels from the upper left corner. A banner at the bottom of
photos of different heights is at the same place from a lower corner.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import numpy as np
import pycolmap
from jaxtyping import Bool, Float

MARGIN = 0.15
"""Height of the margins at the top and the bottom in which captions are looked for, relative to the height."""
STATIONARY = 4.0
"""Largest difference of positions relative to a corner, pixels (COLMAP's for stationary matches)."""
LEAST_CAPTION = 8
"""Smallest number of stationary matches of a caption; fewer may be chance."""


def remove_captions(database: Any, pairs: Collection[tuple[int, int]], verification: Any) -> int:
    """Verifies pairs again without the matches of captions.

    Args:
        database: Database with matches and two-view geometries; both are replaced for pairs with a caption.
        pairs: Ids of the images of each pair.
        verification: Options of the verification (`pycolmap.TwoViewGeometryOptions`).

    Returns:
        Number of pairs with a caption.
    """
    views: dict[int, tuple[Any, Float[np.ndarray, "F 2"]]] = {}
    changed = 0
    for pair in pairs:
        if not database.exists_two_view_geometry(*pair):
            continue
        if not len(database.read_two_view_geometry(*pair).inlier_matches):
            continue
        for image in pair:
            if image not in views:
                camera = database.read_camera(database.read_image(image).camera_id)
                views[image] = camera, database.read_keypoints(image)[:, :2].astype(np.float64)
        (first, first_pixels), (second, second_pixels) = (views[image] for image in pair)
        matches = np.asarray(database.read_matches(*pair))
        caption = find_caption(
            first_pixels[matches[:, 0]],
            second_pixels[matches[:, 1]],
            (first.width, first.height),
            (second.width, second.height),
        )
        if not caption.any():
            continue
        changed += 1
        kept = np.ascontiguousarray(matches[~caption])
        geometry = pycolmap.TwoViewGeometry()
        if len(kept) >= verification.min_num_inliers:
            geometry = pycolmap.estimate_two_view_geometry(
                first, first_pixels, second, second_pixels, kept, verification
            )
        database.delete_matches(*pair)
        database.delete_two_view_geometry(*pair)
        database.write_matches(*pair, kept)
        database.write_two_view_geometry(*pair, geometry)
    return changed


def find_caption(
    first: Float[np.ndarray, "M 2"],
    second: Float[np.ndarray, "M 2"],
    first_size: tuple[int, int],
    second_size: tuple[int, int],
) -> Bool[np.ndarray, " M"]:
    """Matches in the margins that are at the same place of both photos, relative to a corner.

    Captions have the same size in pixels, or the same size relative to the width if an agency scales the photo.

    Args:
        first: Positions of the matches in the first photo, pixels.
        second: Positions in the second photo.
        first_size: Width and height of the first photo.
        second_size: Width and height of the second photo.
    """
    best = np.zeros(len(first), dtype=bool)
    sizes = np.array(first_size, float), np.array(second_size, float)
    for scale in {1.0, first_size[0] / second_size[0]}:
        for corner in ((0, 0), (1, 0), (0, 1), (1, 1)):
            from_corner = (first - sizes[0] * corner) - scale * (second - sizes[1] * corner)
            same = np.abs(from_corner).max(axis=1, initial=0) <= STATIONARY
            for pixels, size in zip((first, second), sizes, strict=True):
                height = pixels[:, 1] / size[1]
                same &= height > 1 - MARGIN if corner[1] else height < MARGIN
            if same.sum() > best.sum():
                best = same
    return best if best.sum() >= LEAST_CAPTION else np.zeros_like(best)
