"""Detects copies and crops of photos: pairs whose matches are related by scale and translation only."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Integer

from wildgs.sfm.database import open_database
from wildgs.sfm.pairs import Pair
from wildgs.sfm.upright import WorkingCopy
from wildgs.sfm.workplace import Workplace

CANDIDATE_LIKENESS = 0.2
"""Smallest similarity by retrieval of candidates; a crop has 0.42, different photos of one place at most 0.3."""

LEAST_MATCHES = 60
LEAST_SHARE = 0.4
"""Smallest fraction of matching features in the common part; photos of one place at different times have 0.15."""
LARGEST_ERROR = 0.003
"""Largest deviation from scale and translation, relative to the longer side."""


def find_crops(work: Workplace, copies: Sequence[WorkingCopy], pairs: Iterable[Pair]) -> dict[int, int]:
    """Maps copies and crops of a photo to the one with the largest field of view.

    Args:
        work: The workplace; its database contains the matches of the pairs.
        copies: All photos.
        pairs: Pairs to check.
    """
    original: dict[int, int] = {}
    with open_database(work.database) as database:
        ids = {image.name: image.image_id for image in database.read_all_images()}
        for a, b in sorted(pairs):
            first, second = ids.get(copies[a].work_name), ids.get(copies[b].work_name)
            if first is None or second is None:
                continue
            scale = crop_scale(database, first, second)
            if scale is None:
                continue
            # The original is the photo with the larger frame, in pixels of the second photo.
            widths = [database.read_camera(database.read_image(i).camera_id).width for i in (first, second)]
            larger, smaller = (a, b) if widths[0] * scale >= widths[1] else (b, a)
            larger, smaller = original.get(larger, larger), original.get(smaller, smaller)
            if larger != smaller:
                original = {k: larger if v == smaller else v for k, v in original.items()} | {smaller: larger}
    return original


def crop_scale(database: Any, first: int, second: int) -> float | None:
    """The scale from the first photo to the second if one is a copy or crop of the other, else None."""
    if not database.exists_two_view_geometry(first, second):
        return None
    matches = database.read_two_view_geometry(first, second).inlier_matches
    if len(matches) < LEAST_MATCHES:
        return None
    places = [database.read_keypoints(image)[:, :2].astype(np.float64) for image in (first, second)]
    cameras = [database.read_camera(database.read_image(image).camera_id) for image in (first, second)]
    return _scale_of_crop(places[0], places[1], matches, (cameras[1].width, cameras[1].height))


def _scale_of_crop(
    first: Float[np.ndarray, "A 2"],
    second: Float[np.ndarray, "B 2"],
    matches: Integer[np.ndarray, "M 2"],
    size: tuple[int, int],
) -> float | None:
    a, b = first[matches[:, 0]], second[matches[:, 1]]
    kept = np.ones(len(a), dtype=bool)
    scale, shift, error = 1.0, np.zeros(2), np.zeros(len(a))
    for _ in range(4):  # least squares on inliers
        centred = a[kept] - a[kept].mean(axis=0)
        scale = float((centred * (b[kept] - b[kept].mean(axis=0))).sum() / max((centred**2).sum(), 1e-9))
        shift = b[kept].mean(axis=0) - scale * a[kept].mean(axis=0)
        error = np.linalg.norm(scale * a + shift - b, axis=1)
        kept = error <= max(2 * float(np.median(error)), 1.0)
    agreeing = int((error <= LARGEST_ERROR * max(size)).sum())
    if scale <= 0 or agreeing < max(LEAST_MATCHES, 0.9 * len(a)):
        return None
    common = [_inside(scale * first + shift, np.zeros(2), np.array(size, np.float64))]
    corners = scale * np.stack([first.min(axis=0), first.max(axis=0)]) + shift
    common.append(_inside(second, corners[0], corners[1]))
    return scale if agreeing >= LEAST_SHARE * min(common) else None


def _inside(
    places: Float[np.ndarray, "N 2"], low: Float[np.ndarray, " 2"], high: Float[np.ndarray, " 2"]
) -> int:
    return int(((places >= low) & (places <= high)).all(axis=1).sum())
