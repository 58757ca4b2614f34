"""Matches features of a photo to points by weak geometric consistency and then guided by the pose found.

Lowe's ratio test rejects most correct matches of photos that differ much from those of the model, because repeated
architecture has similar descriptors. Without the test, nine of ten matches are wrong, too many for RANSAC. But
correct matches agree on the rotation and the scale of the photo, since SIFT features have an orientation and a
size. Those that do not agree with the majority are left out (weak geometric consistency; Jégou, Douze and Schmid,
"Hamming embedding and weak geometric consistency for large scale image search", ECCV 2008). If a pose is found,
features near the projected points are matched again (guided matching). A pose is believed if it has many more of
these matches than the same pose with other points at the same places, which measures chance.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pycolmap
import torch
from jaxtyping import Bool, Float, Float64, Int64, UInt8
from scipy.spatial import KDTree

from wildgs.sfm.feature_index import FeatureIndex, nearest_points
from wildgs.sfm.localization import MIN_INLIERS, solve_pose

ANGLE, OCTAVES = 0.4, 0.6
"""Largest deviation of a match from the dominant rotation, in radians, and from the dominant change of scale."""
TRIALS = 100_000
"""Upper bound on RANSAC trials: 99% certain with 12% of correct matches."""
GUIDED_ERROR = 0.006
"""Largest distance of a guided match from the projected point, relative to the longer side."""
LARGEST_ANGLE = 1.0
"""Largest angle between descriptors of a guided match, radians; unrelated ones have 0.80 to 0.87 in the median."""
GUIDED_ROUNDS = 2
"""Each round refines the pose and matches again."""
CHANCE_RATIO, CHANCE_TRIALS = 1.5, 3
"""How many times as many guided matches a pose needs as with shuffled points (mean of several shufflings)."""


@dataclass(frozen=True)
class Shapes:
    """Orientation and size of features.

    Attributes:
        angles: Orientation in radians.
        sizes: Scale; of features of a photo in pixels, of features that observe a point in world units.
    """

    angles: Float64[np.ndarray, " F"]
    sizes: Float64[np.ndarray, " F"]

    @classmethod
    def of(cls, keypoints: Float[np.ndarray, "F 6"]) -> Shapes:
        """Shapes of COLMAP's keypoints (x, y and a 2 x 2 affine shape)."""
        a11, a12, a21, a22 = keypoints[:, 2:].astype(np.float64).T
        return cls(np.arctan2(a21, a11), (np.hypot(a11, a21) + np.hypot(a12, a22)) / 2)


@dataclass(frozen=True)
class Features:
    """Features of the photo to match.

    Attributes:
        descriptors: SIFT descriptors.
        pixels: Positions.
        shapes: Orientations and sizes.
    """

    descriptors: UInt8[np.ndarray, "F 128"]
    pixels: Float64[np.ndarray, "F 2"]
    shapes: Shapes


@dataclass(frozen=True)
class ConsistentPose:
    """A pose and its matches.

    Attributes:
        camera: The camera with its estimated focal length.
        features: Indices of the matched features.
        points: Indices of their points.
    """

    camera: Any
    features: Int64[np.ndarray, " M"]
    points: Int64[np.ndarray, " M"]


def find_consistent_pose(
    features: Features, index: FeatureIndex, shapes: Shapes, camera: Any, seed: int
) -> ConsistentPose | None:
    """Estimates the pose of a photo from consistent matches; None if it does not stand out from chance.

    Args:
        features: The photo's features.
        index: Points with the descriptors of the features that observe them.
        shapes: Shapes of these features, sizes in world units.
        camera: Initial camera of the photo; not modified.
        seed: Random seed.
    """
    rows, nearest = _nearest(features, index)
    rotation = _wrapped(features.shapes.angles[rows] - shapes.angles[nearest])
    scale = np.log2(features.shapes.sizes[rows] / shapes.sizes[nearest])
    agree = _dominant(rotation, scale)
    rows, points = rows[agree], index.owners[nearest[agree]]
    pose = _solve(features.pixels[rows], index.points[points], camera, seed)
    if pose is None:
        return None
    lens, answer = pose
    rng = np.random.default_rng(seed)
    for _ in range(GUIDED_ROUNDS):
        rows, points = _guided(features, index, shapes, lens, answer["cam_from_world"])
        chance = [
            len(
                _guided(
                    features,
                    index,
                    shapes,
                    lens,
                    answer["cam_from_world"],
                    rng.permutation(len(index.points)),
                )[0]
            )
            for _ in range(CHANCE_TRIALS)
        ]
        if len(rows) < max(MIN_INLIERS, CHANCE_RATIO * float(np.mean(chance))):
            return None
        pose = _solve(features.pixels[rows], index.points[points], camera, seed)
        if pose is None:
            return None
        lens, answer = pose
    kept = np.asarray(answer["inlier_mask"])
    return ConsistentPose(lens, rows[kept], points[kept])


def _nearest(
    features: Features, index: FeatureIndex
) -> tuple[Int64[np.ndarray, " M"], Int64[np.ndarray, " M"]]:
    """For each point its most similar feature and that feature's most similar descriptor of the point."""
    every = FeatureIndex(index.descriptors, np.arange(len(index.descriptors)), index.points)
    likeness, nearest = nearest_points(features.descriptors, every, count=1)
    order = np.argsort(-likeness[:, 0], kind="stable")
    first = np.unique(index.owners[nearest[order, 0]], return_index=True)[1]
    return order[first], nearest[order[first], 0]


def _dominant(rotation: Float[np.ndarray, " M"], scale: Float[np.ndarray, " M"]) -> Bool[np.ndarray, " M"]:
    """Which matches agree with the match with which most agree."""
    agree = np.abs(_wrapped(rotation[:, None] - rotation)) < ANGLE
    agree &= np.abs(scale[:, None] - scale) < OCTAVES
    return agree[agree.sum(axis=1).argmax()] if len(rotation) else np.zeros(0, dtype=bool)


def _wrapped(angle: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch"]:
    return (angle + np.pi) % (2 * np.pi) - np.pi


def _solve(
    pixels: Float[np.ndarray, "M 2"], points: Float[np.ndarray, "M 3"], camera: Any, seed: int
) -> tuple[Any, dict[str, Any]] | None:
    """A copy of the camera with the estimated focal length, and the pose; None with too few inliers."""
    lens = pycolmap.Camera(camera.todict())
    answer = solve_pose(pixels, points, lens, camera.has_prior_focal_length, seed, max_trials=TRIALS)
    if answer is None or answer["num_inliers"] < MIN_INLIERS:
        return None
    lens.params = [*lens.params[:3], 0.0]
    return lens, answer


def _guided(
    features: Features,
    index: FeatureIndex,
    shapes: Shapes,
    lens: Any,
    pose: Any,
    shuffled: Int64[np.ndarray, " P"] | None = None,
) -> tuple[Int64[np.ndarray, " M"], Int64[np.ndarray, " M"]]:
    """Matches points to features near their projections with a similar descriptor, orientation and size.

    With `shuffled`, each point is looked for at the projection of another one.
    """
    local = index.points @ pose.rotation.matrix().T + pose.translation
    if shuffled is not None:
        local = local[shuffled]
    projected = np.full((len(local), 2), -1.0)
    front = local[:, 2] > 1e-6
    projected[front] = lens.img_from_cam(local[front])
    inside = front & ((projected >= 0) & (projected < [lens.width, lens.height])).all(axis=1)
    seen = np.flatnonzero(inside[index.owners])  # descriptors of points inside the photo
    reach = GUIDED_ERROR * max(lens.width, lens.height)
    near = KDTree(features.pixels).query_ball_point(projected[index.owners[seen]], reach)
    rows = (
        np.concatenate([np.array(found, np.int64) for found in near]) if len(seen) else np.zeros(0, np.int64)
    )
    owners = np.repeat(seen, [len(found) for found in near])
    depth = local[index.owners[owners], 2]
    scale = np.log2(features.shapes.sizes[rows] * depth / lens.mean_focal_length() / shapes.sizes[owners])
    turned = _wrapped(features.shapes.angles[rows] - shapes.angles[owners])
    fits = (np.abs(scale) < OCTAVES) & (np.abs(turned) < ANGLE)
    rows, owners = rows[fits], owners[fits]
    cosine = _likeness(features.descriptors[rows], index.descriptors[owners])
    order = np.argsort(-cosine, kind="stable")
    order = order[cosine[order] > np.cos(LARGEST_ANGLE)]
    points = index.owners[owners[order]]
    order = order[np.sort(np.unique(points, return_index=True)[1])]  # the best feature of each point
    order = order[np.sort(np.unique(rows[order], return_index=True)[1])]  # and the best point of each feature
    return rows[order], index.owners[owners[order]]


def _likeness(
    first: UInt8[np.ndarray, "M 128"], second: UInt8[np.ndarray, "M 128"]
) -> Float[np.ndarray, " M"]:
    a, b = (torch.nn.functional.normalize(torch.from_numpy(each).float(), dim=1) for each in (first, second))
    return (a * b).sum(dim=1).double().numpy()
