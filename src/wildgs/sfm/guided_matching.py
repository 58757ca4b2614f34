"""Matches features of photos whose cameras are known along epipolar lines (guided matching).

Lowe's ratio test compares the best match of a feature with the second best anywhere in the other photo, which
repeated architecture makes nearly as similar. Once cameras are known, the second best near the epipolar line is
another one. COLMAP's guided matching does the same, but takes several times as long on a CPU, and features of other
sizes at the place of the best match for the second best.

Source: Hartley and Zisserman, "Multiple view geometry in computer vision", 2004, section 11.6.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt32
from scipy.sparse import csr_array

from wildgs.progress import Counter as Progressed
from wildgs.sfm.guided_kernels import find_clear
from wildgs.sfm.lookalikes import essential_matrix, unproject
from wildgs.threads import launch

ImagePair = tuple[int, int]
"""Ids of two images, the smaller one first."""

Matches = Mapping[ImagePair, UInt32[np.ndarray, "_ 2"]]
"""Indices of matched features by pair of images."""

GuidedMatches = dict[ImagePair, UInt32[np.ndarray, "_ 2"]]
"""The same, of pairs that have been matched along epipolar lines."""

RATIO = 0.7
"""Lowe's ratio: largest angle between descriptors of a match relative to the second smallest."""

LARGEST_ANGLE = 0.8
"""Largest angle between descriptors of a match, radians; unrelated ones have 0.80 to 0.87 in the median."""

SAME_PLACE = 3.0
"""Distance up to which features are at one place, pixels: the same corner has several of different sizes."""

CACHED_PHOTOS = 64
"""Photos whose features are kept in memory, 5 MB each."""


@dataclass(frozen=True)
class _Features:
    """Features of a registered photo.

    Attributes:
        descriptors: Unit vectors.
        pixels: Positions.
        rays: Directions in the camera's frame with z = 1; NaN, which is near no line, where there is none.
        reach: Tangent of the angle within which features are near an epipolar line.
    """

    descriptors: Float32[np.ndarray, "F 128"]
    pixels: Float64[np.ndarray, "F 2"]
    rays: Float64[np.ndarray, "F 3"]
    reach: float


def neighbours(model: Any, most: int, least_shared: int) -> list[ImagePair]:
    """Pairs of each image with those that share most points with it.

    Args:
        model: pycolmap's reconstruction.
        most: Upper bound on the pairs of an image.
        least_shared: Smallest number of points that a pair shares.
    """
    photos = np.array(sorted(model.reg_image_ids()))
    rows = [
        np.unique([element.image_id for element in model.point3D(point).track.elements])
        for point in sorted(model.point3D_ids())
    ]
    if not rows:
        return []
    points = np.repeat(np.arange(len(rows)), [len(row) for row in rows])
    seen = csr_array(
        (np.ones(len(points), np.int32), (np.searchsorted(photos, np.concatenate(rows)), points)),
        shape=(len(photos), len(rows)),
    )
    shared = csr_array(seen @ seen.T)
    pairs = set()
    for row, start, end in zip(range(len(photos)), shared.indptr, shared.indptr[1:], strict=False):
        others, counts = shared.indices[start:end], np.asarray(shared.data[start:end])
        order = np.lexsort((others, np.negative(counts)))
        kept = order[(others[order] != row) & (counts[order] >= least_shared)][:most]
        pairs |= {(int(photos[min(row, other)]), int(photos[max(row, other)])) for other in others[kept]}
    return sorted(pairs)


def match_guided(
    model: Any, database: Any, pairs: Sequence[ImagePair], reach: float, progress: Progressed
) -> GuidedMatches:
    """Matches pairs of photos along epipolar lines.

    Args:
        model: pycolmap's reconstruction, in which the photos have poses.
        database: COLMAP's database with their features.
        pairs: Pairs to match.
        reach: Largest distance of a match from the epipolar line, relative to the longer side.
        progress: Called with (pairs matched, total number of pairs).

    Returns:
        The matches of each pair. A feature has at most one match in another photo.
    """

    @lru_cache(maxsize=CACHED_PHOTOS)
    def features(photo: int) -> _Features:
        return _read(model.image(photo), database, reach)

    found: GuidedMatches = {}
    for done, pair in enumerate(pairs, start=1):
        essential = essential_matrix(*(model.image(photo) for photo in pair))
        found[pair] = _match(features(pair[0]), features(pair[1]), essential)
        progress(done, len(pairs))
    return found


def _read(image: Any, database: Any, reach: float) -> _Features:
    camera = image.camera
    pixels = np.asarray(database.read_keypoints(image.image_id))[:, :2].astype(np.float64)
    descriptors = np.asarray(database.read_descriptors(image.image_id).data).astype(np.float32)
    descriptors /= np.maximum(np.linalg.norm(descriptors, axis=1, keepdims=True), 1e-9)
    side = max(camera.width, camera.height)
    return _Features(
        descriptors, pixels, unproject(camera, pixels), reach * side / camera.mean_focal_length()
    )


def _match(
    first: _Features, second: _Features, essential: Float64[np.ndarray, "3 3"]
) -> UInt32[np.ndarray, "_ 2"]:
    """Mutually best matches near epipolar lines that are clearly better than the second best elsewhere."""
    lines, back = first.rays @ essential.T, second.rays @ essential
    limits = second.reach * np.hypot(lines[:, 0], lines[:, 1])
    back_limits = first.reach * np.hypot(back[:, 0], back[:, 1])
    there = _find_clear(first, lines, limits, second, back_limits)
    again = _find_clear(second, back, back_limits, first, limits)
    rows = np.flatnonzero(there >= 0)
    rows = rows[again[there[rows]] == rows]
    return np.stack([rows, there[rows]], axis=1).astype(np.uint32)


def _find_clear(
    first: _Features,
    lines: Float64[np.ndarray, "F 3"],
    limits: Float64[np.ndarray, " F"],
    second: _Features,
    other_limits: Float64[np.ndarray, " G"],
) -> Int64[np.ndarray, " F"]:
    """The clearly best match of each feature among those near its line, by row; -1 for none."""
    found = np.full(len(limits), -1, np.int64)
    launch(
        find_clear,
        lines.astype(np.float32),
        limits.astype(np.float32),
        first.descriptors,
        np.ascontiguousarray(second.rays[:, :2].T, np.float32),
        other_limits.astype(np.float32),
        second.descriptors,
        second.pixels,
        SAME_PLACE,
        LARGEST_ANGLE,
        RATIO,
        found,
        items=len(found),
    )
    return found
