"""Camera files: our documented JSON (docs/cameras.md), and nerfstudio's camera paths."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float64

from wildgs.errors import UserError
from wildgs.files import written_aside
from wildgs.geometry.camera import Camera

Frame = Literal["scene", "colmap"]
"""Whose world coordinates: the run's aligned ones (+z up, usual depth 1), or those of the COLMAP model."""

FORMAT = "wildgs-cameras-1"
DATAPARSER_FILE = "dataparser_transforms.json"
DEFAULT_FPS = 30.0
MAX_SIDE = 32_768
"""Of a picture, pixels: what a file asks for is allocated."""


@dataclass(frozen=True)
class CameraPath:
    """A trajectory from a file.

    Attributes:
        cameras: One for every frame; their pictures are of one size.
        fps: Frames per second.
        frame: The world in which they stand.
    """

    cameras: tuple[Camera, ...]
    fps: float
    frame: Frame


def write_camera_path(file: Path, cameras: Sequence[Camera], *, fps: float, frame: Frame = "scene") -> None:
    """Writes our JSON.

    Raises:
        UserError: The disk is full or read-only.
    """
    content = {
        "format": FORMAT,
        "frame": frame,
        "fps": fps,
        "cameras": [
            {
                "width": camera.width,
                "height": camera.height,
                "viewmat": camera.viewmat.tolist(),
                "K": camera.K.tolist(),
            }
            for camera in cameras
        ],
    }
    with written_aside(file) as aside:
        aside.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def read_camera_path(file: Path) -> CameraPath:
    """Reads our JSON or nerfstudio's, by what it holds.

    Raises:
        UserError: The file is missing, no JSON, or not a camera file; the message names the entry.
    """
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise UserError(f"{file}: no such file; give a camera file or one of the built-in paths") from error
    except (OSError, ValueError, RecursionError) as error:
        raise UserError(f"{file}: cannot be read as JSON ({error})") from error
    try:
        if isinstance(content, dict) and "camera_path" in content:
            path = _from_nerfstudio(content, file.with_name(DATAPARSER_FILE))
        elif isinstance(content, dict) and "cameras" in content:
            path = _from_own(content)
        else:
            raise ValueError("holds neither 'cameras' (ours) nor 'camera_path' (nerfstudio's)")
    except (KeyError, TypeError, ValueError, OSError, OverflowError, RecursionError) as error:
        reason = f"there is no entry {error}" if isinstance(error, KeyError) else error
        raise UserError(f"{file}: is no camera file: {reason} (docs/cameras.md describes it)") from error
    if not path.cameras:
        raise UserError(f"{file}: holds no cameras")
    return path


def _from_own(content: dict[str, Any]) -> CameraPath:
    frame = content.get("frame", "scene")
    if frame not in ("scene", "colmap"):
        raise ValueError(f"frame {frame!r} is neither 'scene' nor 'colmap'")
    cameras = []
    for number, entry in enumerate(_list(content["cameras"], "cameras")):
        where = f"cameras[{number}]"
        size = (entry.get("width", content.get("width")), entry.get("height", content.get("height")))
        width, height = (_whole(value, where) for value in size)
        K = _matrix(entry["K"], (3, 3), where) if "K" in entry else _from_fov(entry["fov"], width, height)
        cameras.append(_camera(_matrix(entry["viewmat"], (4, 4), where), K, width, height))
    return CameraPath(tuple(cameras), _speed(content), frame)


def _from_nerfstudio(content: dict[str, Any], transforms: Path) -> CameraPath:
    """Nerfstudio's path: camera-to-world with OpenGL axes, vertical field of view.

    Its world is that of its data parser. Where the parser's transform lies beside the file, cameras go back to
    the COLMAP model's frame; else they are taken to be in this run's.
    """
    kind = content.get("camera_type", "perspective")
    if kind != "perspective":
        raise ValueError(f"camera_type {kind!r} is not supported, only 'perspective'")
    width, height = (_whole(content[key], key) for key in ("render_width", "render_height"))
    transform = np.eye(4)
    if transforms.is_file():
        parsed = json.loads(transforms.read_text(encoding="utf-8"))
        transform[:3] = _matrix(parsed["transform"], (3, 4), transforms.name)
        transform[:3] *= float(parsed["scale"])
    back = np.linalg.inv(transform)
    cameras = []
    for number, entry in enumerate(_list(content["camera_path"], "camera_path")):
        pose = back @ _matrix(entry["camera_to_world"], (4, 4), f"camera_path[{number}]")
        volume = np.linalg.det(pose[:3, :3])
        if not 1e-18 < abs(volume) < 1e18:
            raise ValueError(f"camera_path[{number}]: the pose is no rotation")
        pose[:3, :3] /= np.cbrt(volume)  # the parser's scale moves, it does not magnify
        pose[:3, 1:3] *= -1  # OpenGL's y up and z backward to OpenCV's
        K = _from_fov(entry["fov"], width, height)
        cameras.append(_camera(np.linalg.inv(pose), K, width, height))
    return CameraPath(tuple(cameras), _speed(content), "colmap" if transforms.is_file() else "scene")


def _camera(
    viewmat: Float64[np.ndarray, "4 4"], K: Float64[np.ndarray, "3 3"], width: int, height: int
) -> Camera:
    rotation = viewmat[:3, :3]
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) or np.linalg.det(rotation) < 0:
        raise ValueError("a camera's pose is no rotation and translation")
    return Camera(torch.from_numpy(viewmat), torch.from_numpy(K), width, height)


def _list(value: Any, where: str) -> list[dict[str, Any]]:
    if not isinstance(value, list) or not all(isinstance(entry, dict) for entry in value):
        raise ValueError(f"{where} is no list of cameras")
    return value


def _matrix(value: Any, shape: tuple[int, int], where: str) -> np.ndarray:
    matrix = np.array(value, dtype=np.float64)
    if matrix.size != shape[0] * shape[1] or not np.isfinite(matrix).all():
        raise ValueError(f"{where} needs {shape[0]} x {shape[1]} numbers")
    return matrix.reshape(shape)


def _whole(value: Any, where: str) -> int:
    if (
        isinstance(value, bool)
        or not isinstance(value, (int, float))
        or not 1 <= value <= MAX_SIDE
        or value % 1
    ):
        raise ValueError(f"{where}: width and height must be whole numbers from 1 to {MAX_SIDE:,}")
    return int(value)


def _from_fov(degrees: Any, width: int, height: int) -> Float64[np.ndarray, "3 3"]:
    """K from the vertical field of view."""
    if not 0 < float(degrees) < 180:
        raise ValueError(f"a field of view of {degrees} degrees is impossible")
    focal = height / 2 / math.tan(math.radians(float(degrees)) / 2)
    return np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])


def _speed(content: dict[str, Any]) -> float:
    fps = float(content.get("fps", DEFAULT_FPS))
    if not 0 < fps <= 1000:
        raise ValueError(f"fps {fps:g} is not a number of frames per second")
    return fps
