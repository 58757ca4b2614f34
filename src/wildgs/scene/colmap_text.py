"""COLMAP's text model files."""

from __future__ import annotations

import itertools
import re
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from wildgs.errors import WildGSWarning
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


def read_text(folder: Path) -> ModelRecords:
    """Reads cameras.txt, images.txt and points3D.txt.

    Raises:
        ModelFileError: A file is too large or invalid.
    """
    return ModelRecords(
        _read_cameras(folder / "cameras.txt"),
        _read_images(folder / "images.txt"),
        _read_points(folder / "points3D.txt"),
    )


def _check_count(path: Path, found: int) -> None:
    """Warns if a file's comment declares more entries than it has, the only sign of a truncated text file."""
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        head = "".join(line for line in itertools.islice(file, 5) if line.startswith("#"))
    declared = re.search(r"Number of \w+: (\d{1,12})", head)
    if declared is not None and int(declared[1]) > found:
        warnings.warn(
            f"{path}: its comment declares {declared[1]} entries, but it has {found}; it may be truncated",
            WildGSWarning,
            stacklevel=2,
        )


def _lines(path: Path, *, keep_empty: bool = False) -> Iterator[tuple[str, str]]:
    """Yields (location, line) of all lines except comments; bytes that are not UTF-8 are preserved."""
    if path.stat().st_size > MAX_FILE_BYTES:
        raise ModelFileError(f"{path.name}: larger than the limit of {MAX_FILE_BYTES} bytes")
    with path.open(encoding="utf-8-sig", errors="surrogateescape") as file:
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
        raise ModelFileError(f"{where}: {len(values)} numbers instead of at least {least}")
    if kind is int and any(not 0 <= value < 2**64 for value in values):
        raise ModelFileError(f"{where}: a number out of range")
    return values


def _read_cameras(path: Path) -> dict[int, Any]:
    lengths = dict(camera_models().values())
    cameras = {}
    for where, line in _lines(path):
        fields = line.split()
        if len(fields) < 4 or fields[1] not in lengths:
            raise ModelFileError(f"{where}: an unknown camera model")
        camera_id, width, height = _numbers(where, int, [fields[0], *fields[2:4]], 3)
        params = _numbers(where, float, fields[4:], lengths[fields[1]])
        if len(params) != lengths[fields[1]]:
            raise ModelFileError(f"{where}: {len(params)} parameters are too many for {fields[1]}")
        cameras[camera_id] = make_camera(where, camera_id, fields[1], width, height, params)
    _check_count(path, len(cameras))
    return cameras


def _read_images(path: Path) -> list[ImageRecord]:
    """Reads two lines per photo; the second one, its image points, may be empty."""
    images = []
    lines = _lines(path, keep_empty=True)
    for where, line in lines:
        if not line:
            continue
        fields = line.split(maxsplit=9)
        if len(fields) < 10:
            raise ModelFileError(f"{where}: {len(fields)} fields instead of 10")
        image_id, camera_id = _numbers(where, int, [fields[0], fields[8]], 2)
        pose = _numbers(where, float, fields[1:8], 7)
        if len(fields[9].encode(errors="surrogateescape")) > MAX_NAME_BYTES:
            raise ModelFileError(f"{where}: a name of more than {MAX_NAME_BYTES} bytes")
        points = _image_points(*next(lines, (where, "")))
        images.append(ImageRecord(image_id, tuple(pose[:4]), tuple(pose[4:]), camera_id, fields[9], points))
    _check_count(path, len(images))
    return images


def _image_points(where: str, line: str) -> ImagePoints:
    """Reads x, y and the id of a point, or -1, again and again."""
    try:
        numbers = np.array(line.split(), dtype=np.float64).reshape(-1, 3)
    except ValueError as error:
        raise ModelFileError(f"{where}: image points that are not triples of numbers") from error
    ids = np.nan_to_num(numbers[:, 2], nan=-1).clip(-1, 2**62).astype(np.int64)
    return ImagePoints.of(ids, numbers[:, :2])


def _read_points(path: Path) -> PointRecords:
    points = PointList()
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
    _check_count(path, len(points.ids))
    return points.sorted(path.name)
