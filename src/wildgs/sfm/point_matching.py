"""The second pass: matches features of photos without a pose to the points of the model instead of to photos.

A point has the descriptors of all photos that observe it, one of which is likely to be similar to the new view, and
Lowe's ratio test compares different points. Photos of other places have up to 7 inliers, photos that the first pass
left out 18 to 24. Matching to points was proposed by Li et al., "Location recognition using prioritized feature
matching", ECCV 2010.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from contextlib import closing
from typing import Any

import numpy as np
import pycolmap
from jaxtyping import Float, Int64, UInt8
from torch import Tensor

from wildgs.progress import Counter
from wildgs.sfm.feature_index import FeatureIndex, nearest_points, select_matches
from wildgs.sfm.localization import MIN_INLIERS, solve_pose
from wildgs.sfm.mapping import find_registered, missing_from
from wildgs.sfm.matching import image_ids
from wildgs.sfm.upright import WorkingCopy
from wildgs.sfm.workplace import Workplace

RATIOS = (0.85, 0.9)
"""Ratios of Lowe's test, the strict one first."""

MAX_PHOTOS = 100
"""Upper bound on the number of photos whose descriptors are searched, the most similar ones."""


def match_to_points(
    work: Workplace,
    copies: Sequence[WorkingCopy],
    vlads: Float[Tensor, "N D"],
    model: Any,
    seed: int,
    progress: Counter,
) -> list[str]:
    """Writes inlier matches of photos without a pose to the database, as matches between photos.

    Args:
        work: The workplace; its database contains the features, and the matches are written to it.
        copies: All photos.
        vlads: VLAD descriptors of all photos.
        model: The current model.
        seed: Random seed of RANSAC.
        progress: Called with (photos tried, total number of photos).

    Returns:
        Names of the working copies for which a pose was found.
    """
    missing = missing_from(model, copies)
    found = []
    with closing(pycolmap.Database.open(work.database)) as database:
        ids = image_ids(database, copies)
        placed = [row for row, copy in enumerate(copies) if find_registered(model, copy) is not None]
        observed = [_observed(database, find_registered(model, copies[row])) for row in placed]
        for done, row in enumerate(missing):
            progress(done, len(missing))
            image_id = ids[row]
            if image_id is None or not database.num_keypoints_for_image(image_id):
                continue
            nearest = (vlads[placed] @ vlads[row]).topk(min(MAX_PHOTOS, len(placed))).indices.tolist()
            points = _index_points(model, [observed[place] for place in nearest])
            matches = _solve_photo(database, image_id, points, seed)
            if matches is not None:
                _write_matches(database, image_id, *matches, model)
                found.append(copies[row].work_name)
    return found


Observed = tuple[UInt8[np.ndarray, "_ 128"], Int64[np.ndarray, " _"]]
"""Descriptors of an image's features that observe points, and the points' ids."""


def _observed(database: Any, image: Any) -> Observed:
    rows = image.get_observation_point2D_idxs()
    points = image.get_observation_points2D()
    descriptors = np.array(database.read_descriptors(image.image_id).data[rows])
    return descriptors, np.array([point.point3D_id for point in points], np.int64)


def _index_points(model: Any, observed: Sequence[Observed]) -> tuple[FeatureIndex, Int64[np.ndarray, " P"]]:
    """Feature index of the points that some images observe, and the points' ids."""
    unique, owners = np.unique(np.concatenate([ids for _, ids in observed]), return_inverse=True)
    places = np.array([model.point3D(point).xyz for point in unique], np.float64).reshape(-1, 3)
    descriptors = np.concatenate([descriptors for descriptors, _ in observed])
    return FeatureIndex(descriptors, owners.astype(np.int64), places), unique


def _solve_photo(
    database: Any, image_id: int, seen: tuple[FeatureIndex, Int64[np.ndarray, " P"]], seed: int
) -> tuple[Int64[np.ndarray, " M"], Int64[np.ndarray, " M"]] | None:
    """Features and ids of the inlier points of a pose; None without a reliable pose.

    The pose's focal length is written to the camera in the database, as the initial value for mapping.
    """
    index, point_ids = seen
    descriptors = np.array(database.read_descriptors(image_id).data)
    keypoints = database.read_keypoints(image_id)[:, :2].astype(np.float64)
    stored = database.read_camera(database.read_image(image_id).camera_id)
    nearest = nearest_points(descriptors, index)
    for ratio in RATIOS:
        features, points = select_matches(*nearest, ratio)
        camera = pycolmap.Camera(stored.todict())
        answer = solve_pose(
            keypoints[features], index.points[points], camera, stored.has_prior_focal_length, seed
        )
        if answer is not None and answer["num_inliers"] >= MIN_INLIERS:
            camera.params = [*camera.params[:3], 0.0]
            database.update_camera(camera)
            kept = np.asarray(answer["inlier_mask"])
            return features[kept], point_ids[points[kept]]
    return None


def _write_matches(
    database: Any,
    image_id: int,
    features: Int64[np.ndarray, " M"],
    points: Int64[np.ndarray, " M"],
    model: Any,
) -> None:
    """Writes a match between each feature and all observations of its point in other photos."""
    pairs: dict[int, list[tuple[int, int]]] = defaultdict(list)
    for feature, point in zip(features.tolist(), points.tolist(), strict=True):
        for element in model.point3D(point).track.elements:
            pairs[element.image_id].append((feature, element.point2D_idx))
    for other, rows in pairs.items():
        matches = np.array(rows, np.uint32)
        if database.exists_two_view_geometry(image_id, other):
            old = database.read_two_view_geometry(image_id, other).inlier_matches
            fresh = ~np.isin(matches[:, 0], old[:, 0]) & ~np.isin(matches[:, 1], old[:, 1])
            matches = np.concatenate([old, matches[fresh]])
            database.delete_two_view_geometry(image_id, other)
        geometry = pycolmap.TwoViewGeometry()
        geometry.config = pycolmap.TwoViewGeometryConfiguration.UNCALIBRATED
        geometry.inlier_matches = matches
        database.write_two_view_geometry(image_id, other, geometry)
