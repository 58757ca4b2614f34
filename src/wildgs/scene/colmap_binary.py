"""COLMAP's binary model files; declared counts are checked against the file size before memory is allocated."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np

from wildgs.scene.colmap_records import (
    MAX_FILE_BYTES,
    MAX_NAME_BYTES,
    ImagePoints,
    ImageRecord,
    ModelFileError,
    ModelRecords,
    PointList,
    PointRecords,
    camera_models,
    make_camera,
)

_CAMERA = struct.Struct("<IiQQ")
_IMAGE = struct.Struct("<I7dI")
_POINT = struct.Struct("<Q3d3Bd")
_COUNT = struct.Struct("<Q")
_POINT2D = np.dtype([("pixel", "<f8", 2), ("point", "<i8")])
_TRACK_BYTES = 8


def read_binary(folder: Path) -> ModelRecords:
    """Reads cameras.bin, images.bin and points3D.bin.

    Raises:
        ModelFileError: A file is truncated, too large or invalid.
    """
    return ModelRecords(
        _read_cameras(_Bytes(folder / "cameras.bin")),
        _read_images(_Bytes(folder / "images.bin")),
        _read_points(_Bytes(folder / "points3D.bin")),
    )


class _Bytes:
    """Bounds-checked reading of a file."""

    def __init__(self, path: Path) -> None:
        size = path.stat().st_size
        if size > MAX_FILE_BYTES:
            raise ModelFileError(f"{path.name}: {size} bytes exceed the limit of {MAX_FILE_BYTES}")
        self.name = path.name
        self.data = path.read_bytes()
        self.position = 0

    def take(self, kind: struct.Struct) -> tuple[Any, ...]:
        self._need(kind.size)
        values = kind.unpack_from(self.data, self.position)
        self.position += kind.size
        return values

    def count(self, least_bytes: int) -> int:
        """Reads a number of records of at least `least_bytes` each."""
        (number,) = self.take(_COUNT)
        self._need(number * least_bytes)
        return number

    def array(self, dtype: str | np.dtype, count: int) -> np.ndarray:
        size = np.dtype(dtype).itemsize * count
        self._need(size)
        values = np.frombuffer(self.data, dtype, count, self.position)
        self.position += size
        return values

    def text(self) -> str:
        end = self.data.find(b"\0", self.position, self.position + MAX_NAME_BYTES)
        if end < 0:
            raise ModelFileError(f"{self.name}: an unterminated name at byte {self.position}")
        raw = self.data[self.position : end]
        self.position = end + 1
        # Names in other encodings are preserved as bytes.
        return raw.decode("utf-8", errors="surrogateescape")

    def finish(self) -> None:
        if self.position != len(self.data):
            raise ModelFileError(f"{self.name}: {len(self.data) - self.position} bytes too many")

    def _need(self, size: int) -> None:
        if size > len(self.data) - self.position:
            raise ModelFileError(
                f"{self.name}: {size} bytes declared at byte {self.position}, but only "
                f"{len(self.data) - self.position} left"
            )


def _read_cameras(file: _Bytes) -> dict[int, Any]:
    cameras = {}
    for _ in range(file.count(_CAMERA.size)):
        camera_id, model_id, width, height = file.take(_CAMERA)
        if model_id not in camera_models():
            raise ModelFileError(f"{file.name}: camera {camera_id} has the unknown model {model_id}")
        name, length = camera_models()[model_id]
        params = file.array("<f8", length).tolist()
        cameras[camera_id] = make_camera(file.name, camera_id, name, width, height, params)
    file.finish()
    return cameras


def _read_images(file: _Bytes) -> list[ImageRecord]:
    images = []
    for _ in range(file.count(_IMAGE.size + 1 + _COUNT.size)):
        image_id, *pose, camera_id = file.take(_IMAGE)
        name = file.text()
        shown = file.array(_POINT2D, file.count(_POINT2D.itemsize))
        points = ImagePoints.of(shown["point"], shown["pixel"])
        images.append(ImageRecord(image_id, tuple(pose[:4]), tuple(pose[4:]), camera_id, name, points))
    file.finish()
    return images


def _read_points(file: _Bytes) -> PointRecords:
    points = PointList()
    for _ in range(file.count(_POINT.size + _COUNT.size)):
        point_id, x, y, z, red, green, blue, _ = file.take(_POINT)
        points.ids.append(point_id)
        points.xyz.append((x, y, z))
        points.rgb.append((red, green, blue))
        points.tracks.append(file.array("<u4", 2 * file.count(_TRACK_BYTES))[::2])
    file.finish()
    return points.sorted(file.name)
