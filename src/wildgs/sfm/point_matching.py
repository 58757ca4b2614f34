"""The second pass: matches features of photos without a pose to the points of the model instead of to photos.

A point has the descriptors of all photos that observe it, one of which is likely to be similar to the new view, and
Lowe's ratio test compares different points. Photos of other places have up to 7 inliers, photos that the first pass
left out 18 to 24. Matching to points was proposed by Li et al., "Location recognition using prioritized feature
matching", ECCV 2010.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pycolmap
from jaxtyping import Float, Int64, UInt8
from torch import Tensor

from wildgs.progress import Counter
from wildgs.sfm.consistent_matching import Features, Shapes, find_consistent_pose
from wildgs.sfm.database import open_database
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
    *,
    only: Collection[str] | None = None,
) -> list[str]:
    """Writes inlier matches of photos without a pose to the database, as matches between photos.

    Args:
        work: The workplace; its database contains the features, and the matches are written to it.
        copies: All photos.
        vlads: VLAD descriptors of all photos.
        model: The current model.
        seed: Random seed of RANSAC.
        progress: Called with (photos tried, total number of photos).
        only: Names of the working copies to match; None for all without a pose.

    Returns:
        Names of the working copies for which a pose was found.
    """
    missing = [row for row in missing_from(model, copies) if only is None or copies[row].work_name in only]
    found = []
    with open_database(work.database) as database:
        ids = image_ids(database, copies)
        placed = [row for row, copy in enumerate(copies) if find_registered(model, copy) is not None]
        observed = [_observed(database, model, find_registered(model, copies[row])) for row in placed]
        for done, row in enumerate(missing):
            progress(done, len(missing))
            image_id = ids[row]
            if image_id is None or not database.num_keypoints_for_image(image_id):
                continue
            nearest = (vlads[placed] @ vlads[row]).topk(min(MAX_PHOTOS, len(placed))).indices.tolist()
            points = _index_points(model, [observed[place] for place in nearest])
            matches = _solve_photo(database, image_id, points, seed) if len(points.ids) else None
            if matches is not None:
                _write_matches(database, image_id, *matches, model)
                found.append(copies[row].work_name)
    return found


@dataclass(frozen=True)
class _Observed:
    """An image's features that observe points.

    Attributes:
        descriptors: Their descriptors.
        points: Ids of the points.
        shapes: Their orientations, and sizes in world units.
    """

    descriptors: UInt8[np.ndarray, "_ 128"]
    points: Int64[np.ndarray, " _"]
    shapes: Shapes


@dataclass(frozen=True)
class _Indexed:
    """Points that some images observe.

    Attributes:
        index: Their feature index.
        ids: The points' ids.
        shapes: Shapes of the features in the index.
    """

    index: FeatureIndex
    ids: Int64[np.ndarray, " P"]
    shapes: Shapes


def _observed(database: Any, model: Any, image: Any) -> _Observed:
    rows = image.get_observation_point2D_idxs()
    ids = np.array([point.point3D_id for point in image.get_observation_points2D()], np.int64)
    pose = image.cam_from_world()
    places = np.array([model.point3D(point).xyz for point in ids], np.float64).reshape(-1, 3)
    depth = (places @ pose.rotation.matrix().T + pose.translation)[:, 2]
    flat = Shapes.of(database.read_keypoints(image.image_id)[rows])
    shapes = Shapes(flat.angles, flat.sizes * np.maximum(depth, 1e-9) / image.camera.mean_focal_length())
    return _Observed(np.array(database.read_descriptors(image.image_id).data[rows]), ids, shapes)


def _index_points(model: Any, observed: Sequence[_Observed]) -> _Indexed:
    unique, owners = np.unique(np.concatenate([each.points for each in observed]), return_inverse=True)
    places = np.array([model.point3D(point).xyz for point in unique], np.float64).reshape(-1, 3)
    descriptors = np.concatenate([each.descriptors for each in observed])
    angles, sizes = (
        np.concatenate([getattr(each.shapes, name) for each in observed]) for name in ("angles", "sizes")
    )
    return _Indexed(FeatureIndex(descriptors, owners.astype(np.int64), places), unique, Shapes(angles, sizes))


def _solve_photo(
    database: Any, image_id: int, seen: _Indexed, seed: int
) -> tuple[Int64[np.ndarray, " M"], Int64[np.ndarray, " M"]] | None:
    """Features and ids of the inlier points of a pose; None without a reliable pose.

    The pose's focal length is written to the camera in the database, as the initial value for mapping.
    """
    index = seen.index
    keypoints = database.read_keypoints(image_id)
    features = Features(
        np.array(database.read_descriptors(image_id).data),
        keypoints[:, :2].astype(np.float64),
        Shapes.of(keypoints),
    )
    stored = database.read_camera(database.read_image(image_id).camera_id)
    nearest = nearest_points(features.descriptors, index)
    for ratio in RATIOS:
        matched, points = select_matches(*nearest, ratio)
        camera = pycolmap.Camera(stored.todict())
        answer = solve_pose(
            features.pixels[matched], index.points[points], camera, stored.has_prior_focal_length, seed
        )
        if answer is not None and answer["num_inliers"] >= MIN_INLIERS:
            kept = np.asarray(answer["inlier_mask"])
            return _believe(database, camera, matched[kept], seen.ids[points[kept]])
    pose = find_consistent_pose(features, index, seen.shapes, stored, seed)
    return None if pose is None else _believe(database, pose.camera, pose.features, seen.ids[pose.points])


def _believe(
    database: Any, camera: Any, features: Int64[np.ndarray, " M"], points: Int64[np.ndarray, " M"]
) -> tuple[Int64[np.ndarray, " M"], Int64[np.ndarray, " M"]]:
    camera.params = [*camera.params[:3], 0.0]
    database.update_camera(camera)
    return features, points


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
