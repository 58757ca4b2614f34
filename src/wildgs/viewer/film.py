"""A recorded path becomes a video, and a camera file from which `wildgs render` makes it again."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from wildgs.errors import UserError
from wildgs.exporters.video import write_frames
from wildgs.geometry.camera import Camera
from wildgs.geometry.camera_file import write_camera_path
from wildgs.geometry.trajectory import interpolate
from wildgs.viewer.lighting import LightDesk
from wildgs.viewer.recording import ASPECT, VideoOrder
from wildgs.viewer.subject import Subject

FPS = 30.0


def make_film(
    subject: Subject, desk: LightDesk, order: VideoOrder, file: Path, told: Callable[[int, int], bool]
) -> Path:
    """Renders the way through an order's keyframes.

    Args:
        subject: The scene.
        desk: Its light.
        order: What the video shall be.
        file: The video; the camera file gets its name with the ending .json.
        told: Called with (frames done, frames in all) after every frame; False ends the work.

    Returns:
        The video.

    Raises:
        UserError: The video cannot be written, or `told` ended it. Nothing is left then.
    """
    height = order.keyframes[0].height
    width = 2 * round(height * ASPECT / 2)
    cameras = interpolate(order.keyframes, max(2, round(order.seconds * FPS)), width, height)
    write_frames(file, _frames(subject, desk, order.relight, cameras, told), (width, height), FPS)
    write_camera_path(file.with_suffix(".json"), cameras, fps=FPS)
    return file


def free_name(folder: Path) -> Path:
    """The next name for a video in a folder."""
    number = 1
    while (file := folder / f"path_{number:03d}.mp4").exists():
        number += 1
    return file


def _frames(
    subject: Subject, desk: LightDesk, relight: bool, cameras: list[Camera], told: Callable[[int, int], bool]
) -> Iterator[UInt8[np.ndarray, "H W 3"]]:
    look = desk.look(subject)
    for number, camera in enumerate(cameras):
        if relight:
            look = replace(desk, amount=number / (len(cameras) - 1)).look(subject)
        picture, _ = subject.render(camera, look)
        yield picture.numpy()
        if not told(number + 1, len(cameras)):
            raise UserError("the video was not finished: the viewer was closed")
