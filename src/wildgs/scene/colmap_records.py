"""Records of a COLMAP model, for the readers of both formats, which validate all data.

COLMAP's own reader trusts the counts that a file declares, so that a damaged or malicious file can crash the
process (docs/robustness.md). Format: COLMAP's documentation, "Output Format". Image points (points2D) without a
point are skipped.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pycolmap
from jaxtyping import Float32, Float64, Int64, UInt8, UInt64

MAX_FILE_BYTES = 16 * 2**30
MAX_NAME_BYTES = 4096
MAX_CAMERA_SIDE = 10**6


class ModelFileError(Exception):
    """An invalid model file; the message gives the location and the reason."""


@dataclass(frozen=True)
class ImagePoints:
    """The points that a photo shows, and where.

    Attributes:
        point_ids: Ids of the points.
        pixels: Pixels (x, y) of the photo's camera; the centre of the upper left pixel is (0.5, 0.5).
    """

    point_ids: UInt64[np.ndarray, " K"]
    pixels: Float32[np.ndarray, "K 2"]

    @classmethod
    def of(cls, point_ids: Int64[np.ndarray, " K"], pixels: Float64[np.ndarray, "K 2"]) -> ImagePoints:
        """Those of all image points that belong to a point, whose id is not -1."""
        chosen = point_ids >= 0
        with np.errstate(over="ignore"):
            return cls(point_ids[chosen].astype(np.uint64), pixels[chosen].astype(np.float32))


@dataclass(frozen=True)
class ImageRecord:
    """A photo's pose as stored (world to camera), and the points that it shows."""

    image_id: int
    quat: tuple[float, float, float, float]
    translation: tuple[float, float, float]
    camera_id: int
    name: str
    points: ImagePoints


@dataclass
class PointRecords:
    """Sparse points and their tracks, sorted by id.

    Attributes:
        ids: The points' ids.
        xyz: Positions.
        rgb: Colours.
        track_point: Index of the point of each observation.
        track_image: Id of the photo of each observation.
    """

    ids: UInt64[np.ndarray, " P"]
    xyz: Float64[np.ndarray, "P 3"]
    rgb: UInt8[np.ndarray, "P 3"]
    track_point: Int64[np.ndarray, "T"]
    track_image: Int64[np.ndarray, "T"]


@dataclass
class ModelRecords:
    """The content of a model.

    Attributes:
        cameras: pycolmap's cameras by id.
        images: Photos, in the order of the file.
        points: Points.
    """

    cameras: dict[int, Any]
    images: list[ImageRecord]
    points: PointRecords


@dataclass
class PointList:
    """Points in the order of the file."""

    ids: list[int] = field(default_factory=list)
    xyz: list[tuple[float, ...]] = field(default_factory=list)
    rgb: list[tuple[int, ...]] = field(default_factory=list)
    tracks: list[np.ndarray] = field(default_factory=list)

    def sorted(self, where: str) -> PointRecords:
        """Sorts the points by id and concatenates their tracks.

        Raises:
            ModelFileError: Two points have the same id.
        """
        if len(set(self.ids)) != len(self.ids):
            raise ModelFileError(f"{where}: two points have the same id")
        ids = np.array(self.ids, dtype=np.uint64)
        order = np.argsort(ids, kind="stable")
        tracks = [self.tracks[index] for index in order]
        lengths = np.array([len(track) for track in tracks], dtype=np.int64)
        joined = np.concatenate(tracks) if tracks else np.zeros(0)
        return PointRecords(
            ids=ids[order],
            xyz=np.array(self.xyz, dtype=np.float64).reshape(-1, 3)[order],
            rgb=np.array(self.rgb, dtype=np.uint8).reshape(-1, 3)[order],
            track_point=np.repeat(np.arange(len(tracks), dtype=np.int64), lengths),
            track_image=joined.astype(np.int64),
        )


@functools.cache
def camera_models() -> dict[int, tuple[str, int]]:
    """Name and number of parameters of the camera models of this version of pycolmap, by id."""
    models = {}
    for name, kind in pycolmap.CameraModelId.__members__.items():
        if int(kind) >= 0:
            camera = pycolmap.Camera.create_from_model_id(1, kind, 1.0, 2, 2)
            models[int(kind)] = (name, len(camera.params))
    return models


def make_camera(where: str, camera_id: int, model: str, width: int, height: int, params: list[float]) -> Any:
    """Creates a pycolmap camera from values in a file.

    Raises:
        ModelFileError: The size or the parameters are invalid.
    """
    if not (0 < width <= MAX_CAMERA_SIDE and 0 < height <= MAX_CAMERA_SIDE):
        raise ModelFileError(f"{where}: camera {camera_id} is {width}x{height} pixels")
    try:
        return pycolmap.Camera(
            camera_id=camera_id, model=model, width=width, height=height, params=np.array(params)
        )
    except Exception as error:  # pycolmap raises many types
        raise ModelFileError(
            f"{where}: camera {camera_id} has parameters that are invalid for model {model}"
        ) from error
