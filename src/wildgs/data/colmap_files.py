"""COLMAP's model files, binary and text, read without trusting a number in them.

COLMAP's own reader is C++ and believes the counts that a file declares: a hostile or damaged file ends the process
(docs/robustness.md). Here every count is compared with the bytes that are there before anything is allocated.
Format: COLMAP's documentation, "Output Format". Observations (points2D) are passed over: nothing here needs them.
"""

from __future__ import annotations

import functools
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from jaxtyping import Float64, Int64, UInt8

MAX_FILE_BYTES = 16 * 2**30
MAX_NAME_BYTES = 4096
MAX_CAMERA_SIDE = 10**6

_CAMERA = struct.Struct("<IiQQ")
_IMAGE = struct.Struct("<I7dI")
_POINT = struct.Struct("<Q3d3Bd")
_COUNT = struct.Struct("<Q")
_POINT2D_BYTES, _TRACK_BYTES = 24, 8


class ModelFileError(Exception):
    """A model file that is none; the message says where and why."""


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
class _Points:
    """Points as they are read, before they are put in order."""

    ids: list[int] = field(default_factory=list)
    xyz: list[tuple[float, ...]] = field(default_factory=list)
    rgb: list[tuple[int, ...]] = field(default_factory=list)
    tracks: list[np.ndarray] = field(default_factory=list)

    def sorted(self, where: str) -> PointRecords:
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


def read_records(folder: Path) -> ModelRecords:
    """Reads a model's three files, binary if they are there, else text.

    Raises:
        ModelFileError: A file is missing, truncated, too large, or no such file.
    """
    try:
        if all((folder / f"{name}.bin").is_file() for name in ("cameras", "images", "points3D")):
            return ModelRecords(
                _binary_cameras(_Bytes(folder / "cameras.bin")),
                _binary_images(_Bytes(folder / "images.bin")),
                _binary_points(_Bytes(folder / "points3D.bin")),
            )
        return ModelRecords(
            _text_cameras(folder / "cameras.txt"),
            _text_images(folder / "images.txt"),
            _text_points(folder / "points3D.txt"),
        )
    except (OSError, MemoryError) as error:
        raise ModelFileError(str(error) or type(error).__name__) from error


class _Bytes:
    """A file's bytes and a position that never leaves them."""

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
        """A declared number of records, each of at least so many bytes."""
        (number,) = self.take(_COUNT)
        self._need(number * least_bytes)
        return number

    def skip(self, size: int) -> None:
        self._need(size)
        self.position += size

    def array(self, dtype: str, count: int) -> np.ndarray:
        size = np.dtype(dtype).itemsize * count
        self._need(size)
        values = np.frombuffer(self.data, dtype, count, self.position)
        self.position += size
        return values

    def text(self) -> str:
        end = self.data.find(b"\0", self.position, self.position + MAX_NAME_BYTES)
        if end < 0:
            raise ModelFileError(f"{self.name}: a name without an end at byte {self.position}")
        raw = self.data[self.position : end]
        self.position = end + 1
        return _decoded(raw, self.name)

    def finish(self) -> None:
        if self.position != len(self.data):
            raise ModelFileError(f"{self.name}: {len(self.data) - self.position} bytes too many")

    def _need(self, size: int) -> None:
        if size > len(self.data) - self.position:
            raise ModelFileError(
                f"{self.name}: {size} bytes declared at byte {self.position}, "
                f"{len(self.data) - self.position} are there"
            )


def _decoded(raw: bytes, where: str) -> str:
    try:
        return raw.decode("utf-8")
    except UnicodeDecodeError:
        # Photos named in another encoding are found under the bytes that the disk has.
        return raw.decode("utf-8", errors="surrogateescape")


@functools.cache
def _models() -> dict[int, tuple[str, int]]:
    """Camera models by id: name and number of parameters, as this pycolmap knows them."""
    models = {}
    for name, kind in pycolmap.CameraModelId.__members__.items():
        if int(kind) >= 0:
            camera = pycolmap.Camera.create_from_model_id(1, kind, 1.0, 2, 2)
            models[int(kind)] = (name, len(camera.params))
    return models


def _camera(where: str, camera_id: int, model: str, width: int, height: int, params: list[float]) -> Any:
    if not (0 < width <= MAX_CAMERA_SIDE and 0 < height <= MAX_CAMERA_SIDE):
        raise ModelFileError(f"{where}: camera {camera_id} is {width}x{height} pixels")
    try:
        return pycolmap.Camera(
            camera_id=camera_id, model=model, width=width, height=height, params=np.array(params)
        )
    except Exception as error:  # pycolmap raises many kinds
        raise ModelFileError(f"{where}: camera {camera_id} of model {model} makes no sense") from error


def _binary_cameras(file: _Bytes) -> dict[int, Any]:
    cameras = {}
    for _ in range(file.count(_CAMERA.size)):
        camera_id, model_id, width, height = file.take(_CAMERA)
        if model_id not in _models():
            raise ModelFileError(f"{file.name}: camera {camera_id} has the unknown model {model_id}")
        name, length = _models()[model_id]
        params = file.array("<f8", length).tolist()
        cameras[camera_id] = _camera(file.name, camera_id, name, width, height, params)
    file.finish()
    return cameras


def _binary_images(file: _Bytes) -> list[ImageRecord]:
    images = []
    for _ in range(file.count(_IMAGE.size + 1 + _COUNT.size)):
        image_id, *pose, camera_id = file.take(_IMAGE)
        name = file.text()
        file.skip(file.count(_POINT2D_BYTES) * _POINT2D_BYTES)
        images.append(ImageRecord(image_id, tuple(pose[:4]), tuple(pose[4:]), camera_id, name))
    file.finish()
    return images


def _binary_points(file: _Bytes) -> PointRecords:
    points = _Points()
    for _ in range(file.count(_POINT.size + _COUNT.size)):
        point_id, x, y, z, red, green, blue, _ = file.take(_POINT)
        points.ids.append(point_id)
        points.xyz.append((x, y, z))
        points.rgb.append((red, green, blue))
        points.tracks.append(file.array("<u4", 2 * file.count(_TRACK_BYTES))[::2])
    file.finish()
    return points.sorted(file.name)


def _lines(path: Path, *, keep_empty: bool = False) -> Iterator[tuple[str, str]]:
    """(place, line) of all lines that are no comments; bytes that are no UTF-8 stay as they are."""
    if path.stat().st_size > MAX_FILE_BYTES:
        raise ModelFileError(f"{path.name}: larger than the limit of {MAX_FILE_BYTES} bytes")
    with path.open(encoding="utf-8", errors="surrogateescape") as file:
        for number, line in enumerate(file, start=1):
            stripped = line.strip()
            if not stripped.startswith("#") and (stripped or keep_empty):
                yield f"{path.name}, line {number}", stripped


def _numbers(where: str, kind: type, texts: list[str], least: int) -> list[Any]:
    try:
        values = [kind(text) for text in texts]
    except (ValueError, OverflowError) as error:
        raise ModelFileError(f"{where}: {str(error)[:80]}") from error
    if len(values) < least:
        raise ModelFileError(f"{where}: {len(values)} numbers where {least} are needed")
    if kind is int and any(not 0 <= value < 2**64 for value in values):
        raise ModelFileError(f"{where}: a number out of range")
    return values


def _text_cameras(path: Path) -> dict[int, Any]:
    lengths = dict(_models().values())
    cameras = {}
    for where, line in _lines(path):
        fields = line.split()
        if len(fields) < 4 or fields[1] not in lengths:
            raise ModelFileError(f"{where}: no camera of a known model")
        camera_id, width, height = _numbers(where, int, [fields[0], *fields[2:4]], 3)
        params = _numbers(where, float, fields[4:], lengths[fields[1]])
        if len(params) != lengths[fields[1]]:
            raise ModelFileError(f"{where}: {len(params)} parameters are too many for {fields[1]}")
        cameras[camera_id] = _camera(where, camera_id, fields[1], width, height, params)
    return cameras


def _text_images(path: Path) -> list[ImageRecord]:
    """Two lines a photo; the second, its observations, may be empty."""
    images = []
    lines = _lines(path, keep_empty=True)
    for where, line in lines:
        if not line:
            continue
        fields = line.split(maxsplit=9)
        if len(fields) < 10:
            raise ModelFileError(f"{where}: {len(fields)} fields where a photo has 10")
        image_id, camera_id = _numbers(where, int, [fields[0], fields[8]], 2)
        pose = _numbers(where, float, fields[1:8], 7)
        if len(fields[9].encode(errors="surrogateescape")) > MAX_NAME_BYTES:
            raise ModelFileError(f"{where}: a name of more than {MAX_NAME_BYTES} bytes")
        images.append(ImageRecord(image_id, tuple(pose[:4]), tuple(pose[4:]), camera_id, fields[9]))
        next(lines, None)
    return images


def _text_points(path: Path) -> PointRecords:
    points = _Points()
    for where, line in _lines(path):
        fields = line.split()
        x, y, z = _numbers(where, float, fields[1:4], 3)
        whole = _numbers(where, int, [fields[0], *fields[4:7], *fields[8:]], 4)
        if max(whole[1:4]) > 255 or max(whole[4::2], default=0) >= 2**32:
            raise ModelFileError(f"{where}: a number out of range")
        points.ids.append(whole[0])
        points.xyz.append((x, y, z))
        points.rgb.append(tuple(whole[1:4]))
        points.tracks.append(np.array(whole[4::2], dtype=np.int64))
    return points.sorted(path.name)
