"""Observations of a model's points, and how the cameras say that each looks from another one."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, Int64

from wildgs.sfm.config import CONFIRMED
from wildgs.sfm.consistent_matching import Shapes
from wildgs.sfm.database import open_database
from wildgs.sfm.workplace import Workplace

FEATURE_SCALE = 2.0
"""Scale of a feature, in pixels, up to which the samples of its patch are a pixel apart, and from which they are
farther apart in proportion: a detector places larger features less exactly."""

NEAREST = 1e-6
"""Smallest depth of a point before a camera that shows it."""


@dataclass(frozen=True)
class Tracks:
    """Observations of points, those of one point together.

    Attributes:
        photos: Image id of each observation.
        features: Index of its feature.
        pixels: Where the feature is.
        warps: Matrix from samples of a patch of the point's reference to pixels of the photo.
        starts: Row of each point's first observation, and the number of observations.
        references: Row of the reference of each point, the observation that has the median resolution.
    """

    photos: Int64[np.ndarray, " O"]
    features: Int64[np.ndarray, " O"]
    pixels: Float64[np.ndarray, "O 2"]
    warps: Float64[np.ndarray, "O 2 2"]
    starts: Int64[np.ndarray, " _"]
    references: Int64[np.ndarray, " P"]

    @classmethod
    def of(cls, work: Workplace, model: Any) -> Tracks:
        """The observations of all points that enough photos show.

        Args:
            work: The workplace, whose database knows the scales of the features.
            model: pycolmap's reconstruction.
        """
        points = [model.point3D(point) for point in sorted(model.point3D_ids())]
        points = [point for point in points if point.track.length() >= CONFIRMED]
        elements = [(e.image_id, e.point2D_idx) for point in points for e in point.track.elements]
        photos, features = np.array(elements, np.int64).reshape(-1, 2).T
        lengths = np.array([point.track.length() for point in points], np.int64)
        starts = np.concatenate([[0], np.cumsum(lengths)])
        places = np.array([point.xyz for point in points], np.float64).reshape(-1, 3)
        seen = _Seen.by(work, model, photos, features, np.repeat(places, lengths, axis=0))
        order = np.lexsort((seen.sides, np.repeat(np.arange(len(points)), lengths)))
        references = order[(starts[:-1] + starts[1:]) // 2]
        warps = _warps(seen, starts, references)
        return cls(photos, features, seen.pixels, warps, starts, references)


@dataclass(frozen=True)
class _Seen:
    """Observations and their cameras.

    Attributes:
        pixels: Where the features are.
        scales: Scales of the features, pixels.
        sides: Size of a pixel at the point, world units; infinite for a point that is not before the camera.
        toward: Unit vectors from the points to the cameras.
        slopes: Derivatives of the pixel by the point's place.
    """

    pixels: Float64[np.ndarray, "O 2"]
    scales: Float64[np.ndarray, " O"]
    sides: Float64[np.ndarray, " O"]
    toward: Float64[np.ndarray, "O 3"]
    slopes: Float64[np.ndarray, "O 2 3"]

    @classmethod
    def by(
        cls,
        work: Workplace,
        model: Any,
        photos: Int64[np.ndarray, " O"],
        features: Int64[np.ndarray, " O"],
        places: Float64[np.ndarray, "O 3"],
    ) -> _Seen:
        """Reads the cameras and features of observations."""
        count = len(photos)
        seen = cls(
            np.zeros((count, 2)),
            np.zeros(count),
            np.full(count, np.inf),
            np.zeros((count, 3)),
            np.zeros((count, 2, 3)),
        )
        with open_database(work.database) as database:
            for photo, rows in rows_by_photo(photos):
                image = model.image(photo)
                seen.pixels[rows] = [image.point2D(feature).xy for feature in features[rows]]
                seen.scales[rows] = Shapes.of(database.read_keypoints(photo)[features[rows]]).sizes
                seen._project(rows, image, places[rows])
        return seen

    def _project(self, rows: Int64[np.ndarray, " K"], image: Any, places: Float64[np.ndarray, "K 3"]) -> None:
        pose, focal = image.cam_from_world(), image.camera.mean_focal_length()
        turn = pose.rotation.matrix()
        x, y, depth = (places @ turn.T + pose.translation).T
        before = depth > NEAREST
        depth = np.where(before, depth, 1.0)
        toward = image.projection_center() - places
        self.sides[rows] = np.where(before, depth / focal, np.inf)
        self.toward[rows] = toward / np.linalg.norm(toward, axis=1, keepdims=True)
        one, none = np.ones_like(depth), np.zeros_like(depth)
        plane = np.stack([np.stack([one, none, -x / depth], 1), np.stack([none, one, -y / depth], 1)], 1)
        self.slopes[rows] = (focal / depth)[:, None, None] * (plane @ turn)


def rows_by_photo(photos: Int64[np.ndarray, " O"]) -> Iterator[tuple[int, Int64[np.ndarray, " K"]]]:
    """Each photo's image id and the rows of its observations."""
    order = np.argsort(photos, kind="stable")
    ids, starts = np.unique(photos[order], return_index=True)
    for photo, start, end in zip(ids, starts, np.append(starts, len(order))[1:], strict=True):
        yield int(photo), order[start:end]


def _warps(
    seen: _Seen, starts: Int64[np.ndarray, " _"], references: Int64[np.ndarray, " P"]
) -> Float64[np.ndarray, "O 2 2"]:
    """How each observation shows a patch of the reference; 0 where it does not.

    Patches are on planes that face the mean of a point's cameras.
    """
    facing = np.add.reduceat(seen.toward, starts[:-1]) if len(references) else np.zeros((0, 3))
    normals = facing / np.maximum(np.linalg.norm(facing, axis=1, keepdims=True), 1e-12)
    helper = np.eye(3)[np.abs(normals).argmin(axis=1)]
    across = np.cross(normals, helper)
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
    frames = np.stack([across, np.cross(normals, across)], axis=2)
    owners = np.repeat(np.arange(len(references)), np.diff(starts))
    seen_frames = seen.slopes @ frames[owners]
    known = seen_frames[references]
    regular = _is_regular(known, seen.sides[references])
    sound = np.isfinite(seen.sides) & regular[owners]
    steps = np.maximum(seen.scales[references] / FEATURE_SCALE, 1.0)
    inverse = np.zeros_like(known)
    inverse[regular] = np.linalg.inv(known[regular])
    warps = seen_frames @ (inverse * steps[:, None, None])[owners]
    return np.where(sound[:, None, None], warps, 0.0)


def _is_regular(
    frames: Float64[np.ndarray, "P 2 2"], sides: Float64[np.ndarray, " P"]
) -> Bool[np.ndarray, " P"]:
    """Where a frame on a plane can be told from its picture: the plane is not seen along its surface."""
    return np.isfinite(sides) & (np.abs(np.linalg.det(frames)) * sides**2 > 1e-3)
