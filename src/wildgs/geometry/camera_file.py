"""Camera files: the JSON format of docs/cameras.md, and nerfstudio's camera paths."""

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
from wildgs.files import read_json, written_aside
from wildgs.geometry.camera import Camera

Frame = Literal["scene", "colmap"]
"""World frame: the aligned frame of the run (+z up, median depth 1), or that of the COLMAP model."""

FORMAT = "wildgs-cameras-1"
DATAPARSER_FILE = "dataparser_transforms.json"
DEFAULT_FPS = 30.0
MAX_SIDE = 32_768
"""Maximum width and height in pixels, since images of this size are allocated."""
LEAST_FOCAL, MAX_INTRINSIC = 1e-3, 1e9


@dataclass(frozen=True)
class CameraPath:
    """A camera path: one camera per frame (for a video all of one size), and their world frame."""

    cameras: tuple[Camera, ...]
    fps: float
    frame: Frame


def write_camera_path(file: Path, cameras: Sequence[Camera], *, fps: float, frame: Frame = "scene") -> None:
    """Writes cameras in the format of docs/cameras.md.

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
    """Reads a camera file of either format, which is detected.

    Raises:
        UserError: The file is missing or not a valid camera file; the message names the entry.
    """
    try:
        content = read_json(file)
    except FileNotFoundError as error:
        raise UserError(f"{file}: no such file; give a camera file or one of the built-in paths") from error
    except (OSError, ValueError) as error:
        raise UserError(f"{file}: cannot be read as JSON ({error})") from error
    try:
        if isinstance(content, dict) and "camera_path" in content:
            path = _from_nerfstudio(content, file.with_name(DATAPARSER_FILE))
        elif isinstance(content, dict) and "cameras" in content:
            path = _from_own(content)
        else:
            raise ValueError("it has neither 'cameras' (Wild-GS) nor 'camera_path' (nerfstudio)")
    except (KeyError, TypeError, ValueError, OSError, OverflowError, RecursionError) as error:
        reason = f"missing entry {error}" if isinstance(error, KeyError) else error
        raise UserError(f"{file}: not a valid camera file: {reason} (see docs/cameras.md)") from error
    if not path.cameras:
        raise UserError(f"{file}: contains no cameras")
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
    """Converts nerfstudio's camera path: camera-to-world with OpenGL axes, vertical field of view.

    Its world frame is that of nerfstudio's data parser. If the file with the parser's transform is in the same
    folder, cameras are transformed to the frame of the COLMAP model; otherwise they are assumed to be in the frame
    of this run.
    """
    kind = content.get("camera_type", "perspective")
    if kind != "perspective":
        raise ValueError(f"camera_type {kind!r} is not supported, only 'perspective'")
    width, height = (_whole(content[key], key) for key in ("render_width", "render_height"))
    transform = np.eye(4)
    if transforms.is_file():
        parsed = read_json(transforms)
        transform[:3] = _matrix(parsed["transform"], (3, 4), transforms.name)
        transform[:3] *= float(parsed["scale"])
    back = np.linalg.inv(transform)
    cameras = []
    for number, entry in enumerate(_list(content["camera_path"], "camera_path")):
        pose = back @ _matrix(entry["camera_to_world"], (4, 4), f"camera_path[{number}]")
        volume = np.linalg.det(pose[:3, :3])
        if not 1e-18 < abs(volume) < 1e18:
            raise ValueError(f"camera_path[{number}]: the pose is not a rigid transform")
        pose[:3, :3] /= np.cbrt(volume)  # the parser's scale applies to positions only
        pose[:3, 1:3] *= -1  # from OpenGL (y up, z backward) to OpenCV (y down, z forward)
        K = _from_fov(entry["fov"], width, height)
        cameras.append(_camera(np.linalg.inv(pose), K, width, height))
    return CameraPath(tuple(cameras), _speed(content), "colmap" if transforms.is_file() else "scene")


def _camera(
    viewmat: Float64[np.ndarray, "4 4"], K: Float64[np.ndarray, "3 3"], width: int, height: int
) -> Camera:
    rotation = viewmat[:3, :3]
    rigid = np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) and np.linalg.det(rotation) > 0
    if not rigid or viewmat[3, 3] != 1:
        raise ValueError("a camera pose is not a rigid transform")
    pinhole = [[K[0, 0], 0, K[0, 2]], [0, K[1, 1], K[1, 2]], [0, 0, 1]]
    if not np.array_equal(K, pinhole) or min(K[0, 0], K[1, 1]) < LEAST_FOCAL or K.max() > MAX_INTRINSIC:
        raise ValueError(
            "K must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with focal lengths above 0, in pixels"
        )
    return Camera(torch.from_numpy(viewmat), torch.from_numpy(K), width, height)


def _list(value: Any, where: str) -> list[dict[str, Any]]:
    if not isinstance(value, list) or not all(isinstance(entry, dict) for entry in value):
        raise ValueError(f"{where} is not a list of cameras")
    return value


def _matrix(value: Any, shape: tuple[int, int], where: str) -> np.ndarray:
    matrix = np.array(value, dtype=np.float64)
    if matrix.size != shape[0] * shape[1] or not np.isfinite(matrix).all():
        raise ValueError(f"{where}: expected {shape[0]} x {shape[1]} finite numbers")
    return matrix.reshape(shape)


def _whole(value: Any, where: str) -> int:
    if (
        isinstance(value, bool)
        or not isinstance(value, (int, float))
        or not 1 <= value <= MAX_SIDE
        or value % 1
    ):
        raise ValueError(f"{where}: width and height must be integers from 1 to {MAX_SIDE:,}")
    return int(value)


def _from_fov(degrees: Any, width: int, height: int) -> Float64[np.ndarray, "3 3"]:
    """Intrinsics from a vertical field of view in degrees."""
    if not 0 < float(degrees) < 180:
        raise ValueError(f"fov {degrees}: must be between 0 and 180 degrees")
    focal = height / 2 / math.tan(math.radians(float(degrees)) / 2)
    return np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])


def _speed(content: dict[str, Any]) -> float:
    fps = float(content.get("fps", DEFAULT_FPS))
    if not 0 < fps <= 1000:
        raise ValueError(f"fps {fps:g}: must be above 0 and at most 1000")
    return fps
