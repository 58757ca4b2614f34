"""Trajectories by what a user writes: a built-in one, through photos by name, or from a file."""

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
    """Cameras of a video, in the scene's aligned frame.

    Args:
        scene: The scene.
        kind: `orbit`, `training`, `spiral`, `views`, `still`, or the path of a camera file.
        frames: How many; a camera file has its own number.
        size: Width and height of the pictures; None takes the photos' usual size, or the photo's or file's own.
        views: Names of photos, for `views` and `still`.

    Raises:
        UserError: There is no such path or photo, or the file cannot be read.
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
        known = ", ".join([*AROUND, *THROUGH])
        raise UserError(f"{kind}: there is no such path; choose {known}, or give a camera file (.json)")
    if size is not None:
        raise UserError(f"{kind}: a camera file says itself how large its pictures are; leave the size out")
    return read_path(scene, Path(kind))[0]


def read_path(scene: Scene, file: Path) -> tuple[list[Camera], float]:
    """Cameras of a camera file in the scene's aligned frame, and its frames per second.

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
        # Not through a new lens: the photo's own camera may have its centre off the middle.
        return [camera] * frames if size is None else still(camera, frames, *size)
    return interpolate([view.camera for view in chosen], frames, *(size or usual_size(chosen)))


def usual_size(views: Sequence[View]) -> tuple[int, int]:
    """Median short and long side of photos, rounded down to even numbers; it lies, as screens do.

    It stands where two thirds of the photos do: what people turn their cameras for (a tower, a statue) does not
    fit on a frame that lies.
    """
    sizes = np.array([sorted((view.camera.width, view.camera.height)) for view in views])
    short, long = (max(2, int(np.median(side)) // 2 * 2) for side in sizes.T)
    standing = sum(view.camera.height > view.camera.width for view in views)
    return (short, long) if 3 * standing >= 2 * len(views) > 0 else (long, short)
