"""Initial pairs for incremental mapping, ranked by how many other photos can be added to them.

COLMAP starts with the photo that has most matches and a partner at a large angle. If their matches are seen in no
other photo, the model ends with these two, and another random seed hardly changes the choice.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from jaxtyping import Float64, Shaped

from wildgs.sfm.database import open_database
from wildgs.sfm.lookalikes import verified_matches

LEAST_MATCHES = 15
"""Smallest number of matches of a pair: COLMAP's for considering it at all."""

LEAST_ANGLE = 4.0
"""Smallest median angle between the rays of the matches, degrees."""

CANDIDATES = 2000
"""Number of pairs with most matches that are ranked."""

LEAST_SEEN, ENOUGH_SEEN = 8, 30
"""Number of the pair's matches that another photo has to match to be counted, and from which it counts in full."""

Neighbours = Mapping[int, Mapping[int, Shaped[np.ndarray, "M 2"]]]
"""Matches of a photo with others, by ids; the first column has the photo's own features."""


def initial_pairs(
    database_file: Path, names: Collection[str] = (), seed: int = 0
) -> Iterator[tuple[int, int]]:
    """Pairs of photos to start a model with, the most promising one first.

    Pairs of photos from nearly the same place, as copies are, are left out.

    Args:
        database_file: Database with features and verified matches.
        names: Names of the photos in the model; empty for all.
        seed: Random seed of RANSAC.

    Yields:
        Ids of two images.
    """
    with open_database(database_file) as database:
        images = database.read_all_images()
    photos = [image.image_id for image in images if not names or image.name in names]
    matches = dict(verified_matches(photos, database_file, LEAST_MATCHES))
    neighbours: dict[int, dict[int, Any]] = defaultdict(dict)
    for (first, second), indices in matches.items():
        neighbours[first][second], neighbours[second][first] = indices, indices[:, ::-1]
    strongest = sorted(matches, key=lambda pair: len(matches[pair]), reverse=True)[:CANDIDATES]
    seen = {pair: count_seen(neighbours, *pair) for pair in strongest}
    for pair in sorted(strongest, key=lambda pair: seen[pair], reverse=True):
        with open_database(database_file) as database:
            angle = _angle(database, pair, matches[pair], seed)
        if angle >= LEAST_ANGLE:
            yield pair


def count_seen(neighbours: Neighbours, first: int, second: int) -> int:
    """The pair's matches that other photos match with either photo, summed over those photos.

    Each photo counts for at most `ENOUGH_SEEN`, so that many photos are better than one that matches everything.
    """
    matches = neighbours[first][second]
    count = 0
    for other in (neighbours[first].keys() | neighbours[second].keys()) - {first, second}:
        hit = np.zeros(len(matches), dtype=bool)
        for side, photo in enumerate((first, second)):
            if other in neighbours[photo]:
                hit |= np.isin(matches[:, side], neighbours[photo][other][:, 0])
        if hit.sum() >= LEAST_SEEN:
            count += min(int(hit.sum()), ENOUGH_SEEN)
    return count


def _angle(database: Any, pair: tuple[int, int], matches: Shaped[np.ndarray, "M 2"], seed: int) -> float:
    """Median angle between the rays of matches, degrees, with the current estimates of the lenses."""
    options = pycolmap.TwoViewGeometryOptions()
    options.compute_relative_pose = True
    options.ransac.random_seed = seed
    first, second = ((_camera(database, photo), _keypoints(database, photo)) for photo in pair)
    geometry = pycolmap.estimate_calibrated_two_view_geometry(*first, *second, matches, options)
    return float(np.degrees(geometry.tri_angle))


def _camera(database: Any, photo: int) -> Any:
    return database.read_camera(database.read_image(photo).camera_id)


def _keypoints(database: Any, photo: int) -> Float64[np.ndarray, "N 2"]:
    return database.read_keypoints(photo)[:, :2].astype(np.float64)
