"""Records of a COLMAP model, and what its two formats share: nothing in a file is trusted.

COLMAP's own reader is C++ and trusts the counts that a file declares: a damaged or malicious file can crash the
process (docs/robustness.md). Format: COLMAP's documentation, "Output Format". Observations (points2D) are passed
over, because nothing here needs them.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pycolmap
from jaxtyping import Float64, Int64, UInt8

MAX_FILE_BYTES = 16 * 2**30
MAX_NAME_BYTES = 4096
MAX_CAMERA_SIDE = 10**6


class ModelFileError(Exception):
    """An invalid model file; the message says where and why."""


@dataclass(frozen=True)
class ImageRecord:
    """A photo's pose as stored: world to camera."""

    image_id: int
    quat: tuple[float, float, float, float]
    translation: tuple[float, float, float]
    camera_id: int
    name: str


@dataclass
class PointRecords:
    """Sparse points and which photos see them, in the order of the points' ids.

    Attributes:
        xyz: Positions.
        rgb: Colours.
        track_point: For each observation the point's row.
        track_image: For each observation the photo's id.
    """

    xyz: Float64[np.ndarray, "P 3"]
    rgb: UInt8[np.ndarray, "P 3"]
    track_point: Int64[np.ndarray, "T"]
    track_image: Int64[np.ndarray, "T"]


@dataclass
class ModelRecords:
    """All of a model.

    Attributes:
        cameras: pycolmap's cameras by id.
        images: Photos in the file's order.
        points: Points.
    """

    cameras: dict[int, Any]
    images: list[ImageRecord]
    points: PointRecords


@dataclass
class PointList:
    """Points as they are read, before they are put in order."""

    ids: list[int] = field(default_factory=list)
    xyz: list[tuple[float, ...]] = field(default_factory=list)
    rgb: list[tuple[int, ...]] = field(default_factory=list)
    tracks: list[np.ndarray] = field(default_factory=list)

    def sorted(self, where: str) -> PointRecords:
        """The points by id, with their tracks joined.

        Raises:
            ModelFileError: Two points have one id.
        """
        if len(set(self.ids)) != len(self.ids):
            raise ModelFileError(f"{where}: two points have one id")
        order = np.argsort(np.array(self.ids, dtype=np.uint64), kind="stable")
        tracks = [self.tracks[index] for index in order]
        lengths = np.array([len(track) for track in tracks], dtype=np.int64)
        joined = np.concatenate(tracks) if tracks else np.zeros(0)
        return PointRecords(
            xyz=np.array(self.xyz, dtype=np.float64).reshape(-1, 3)[order],
            rgb=np.array(self.rgb, dtype=np.uint8).reshape(-1, 3)[order],
            track_point=np.repeat(np.arange(len(tracks), dtype=np.int64), lengths),
            track_image=joined.astype(np.int64),
        )


@functools.cache
def camera_models() -> dict[int, tuple[str, int]]:
    """Camera models by id: name and number of parameters, as this pycolmap knows them."""
    models = {}
    for name, kind in pycolmap.CameraModelId.__members__.items():
        if int(kind) >= 0:
            camera = pycolmap.Camera.create_from_model_id(1, kind, 1.0, 2, 2)
            models[int(kind)] = (name, len(camera.params))
    return models


def make_camera(where: str, camera_id: int, model: str, width: int, height: int, params: list[float]) -> Any:
    """A camera as pycolmap has it, from numbers out of a file.

    Raises:
        ModelFileError: It has no area, is too large, or its parameters are not its model's.
    """
    if not (0 < width <= MAX_CAMERA_SIDE and 0 < height <= MAX_CAMERA_SIDE):
        raise ModelFileError(f"{where}: camera {camera_id} is {width}x{height} pixels")
    try:
        return pycolmap.Camera(
            camera_id=camera_id, model=model, width=width, height=height, params=np.array(params)
        )
    except Exception as error:  # pycolmap raises many kinds
        raise ModelFileError(
            f"{where}: camera {camera_id} has parameters that are invalid for model {model}"
        ) from error
