"""Camera paths by name: built-in ones, through photos, or from a file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from wildgs.errors import UserError
from wildgs.geometry.camera import Camera
from wildgs.geometry.camera_file import CameraPath, read_camera_path
from wildgs.geometry.trajectory import interpolate, orbit, spiral, still, training_path
from wildgs.scene.scene import Scene, View, find_view

AROUND = {"orbit": orbit, "training": training_path, "spiral": spiral}
THROUGH = ("views", "still")


def make_path(
    scene: Scene,
    kind: str | Path,
    *,
    frames: int,
    size: tuple[int, int] | None = None,
    views: Sequence[str] = (),
) -> list[Camera]:
    """Cameras along a path, in the aligned frame.

    Args:
        scene: The scene.
        kind: `orbit`, `training`, `spiral`, `views`, `still`, or a camera file.
        frames: Number of cameras; a camera file has its own.
        size: Width and height in pixels; None takes that of the file, the still's photo, or the typical photo.
        views: Names of photos, for `views` and `still`.

    Raises:
        UserError: The path or a photo does not exist, or the file cannot be read.
    """
    if frames < 1:
        raise UserError(f"{frames} frames: a path needs at least one")
    if str(kind) in AROUND:
        cameras = [view.camera for view in scene.train_views]
        points = scene.points.double().numpy()
        return AROUND[str(kind)](cameras, points, frames, *(size or usual_size(scene.views)))
    if str(kind) in THROUGH:
        return _through(scene, str(kind), frames, size, views)
    if not Path(kind).suffix:
        paths = ", ".join([*AROUND, *THROUGH])
        raise UserError(f"{kind}: unknown path; choose {paths}, or give a camera file (.json)")
    if size is not None:
        raise UserError(f"{kind}: a camera file defines the size of its images; leave the size out")
    return read_path(scene, Path(kind))[0]


def read_path(scene: Scene, file: Path) -> tuple[list[Camera], float]:
    """Cameras of a camera file in the aligned frame, and its frames per second.

    Raises:
        UserError: The file cannot be used.
    """
    path: CameraPath = read_camera_path(file)
    cameras = path.cameras
    if path.frame == "colmap":
        cameras = [scene.alignment.apply_camera(camera) for camera in cameras]
    return [replace(c, viewmat=c.viewmat.float(), K=c.K.float()) for c in cameras], path.fps


def _through(
    scene: Scene, kind: str, frames: int, size: tuple[int, int] | None, names: Sequence[str]
) -> list[Camera]:
    least, most = (1, 1) if kind == "still" else (2, len(scene.views))
    if not least <= len(names) <= most:
        wanted = "one photo" if kind == "still" else "at least two photos"
        raise UserError(f"the path {kind!r} needs {wanted} by name (--view), not {len(names)}")
    chosen = [find_view(scene, name) for name in names]
    if kind == "still":
        camera = chosen[0].camera
        # The photo's own camera, whose principal point may not be the centre of the image.
        return [camera] * frames if size is None else still(camera, frames, *size)
    return interpolate([view.camera for view in chosen], frames, *(size or usual_size(chosen)))


def usual_size(views: Sequence[View]) -> tuple[int, int]:
    """Typical size of photos: median short and long side, rounded down to even numbers.

    Landscape, or portrait if at least two thirds of the photos are (of a tower or a statue, for example).
    """
    sizes = np.array([sorted((view.camera.width, view.camera.height)) for view in views])
    short, long = (max(2, int(np.median(side)) // 2 * 2) for side in sizes.T)
    portraits = sum(view.camera.height > view.camera.width for view in views)
    return (short, long) if 3 * portraits >= 2 * len(views) > 0 else (long, short)
