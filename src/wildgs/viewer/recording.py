"""A camera path: key frames, and a video and a camera file made from them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import UInt8

from wildgs.errors import UserError
from wildgs.exporters.video import write_frames
from wildgs.geometry.camera import Camera
from wildgs.geometry.camera_file import write_camera_path
from wildgs.geometry.trajectory import interpolate
from wildgs.viewer.cameras import Pose, camera_of
from wildgs.viewer.lighting import LightDesk
from wildgs.viewer.markup import escape
from wildgs.viewer.subject import Subject

if TYPE_CHECKING:
    import viser

PARENT = "/path"
HEIGHTS = ("360", "480", "720", "1080")
ASPECT = 16 / 9
MIN_VIEWS, MAX_VIEWS = 2, 200
SECONDS = (1.0, 60.0)
"""Shortest and longest video."""
COLOR = (77, 171, 247)
MARKER_SIZE = 0.04


@dataclass(frozen=True)
class VideoOrder:
    """Settings of a video.

    Attributes:
        keyframes: Cameras to interpolate, at least two.
        seconds: Length of the video.
        relight: Whether the light changes from the left to the right one during the video.
    """

    keyframes: tuple[Camera, ...]
    seconds: float
    relight: bool


class RecordingPanel:
    """The controls of a camera path, and its key frames as frustums in the scene."""

    def __init__(
        self,
        server: viser.ViserServer,
        folder: Path | None,
        ordered: Callable[[viser.ClientHandle | None], None],
    ) -> None:
        """Adds the controls to the open container.

        Args:
            server: The viewer's server.
            folder: Folder for videos; None if videos are not available (during training).
            ordered: Called on a thread of viser with the client that requests the video.
        """
        self.folder = folder
        self._server, self._ordered = server, ordered
        self._poses: list[Pose] = []
        self._markers: list[viser.CameraFrustumHandle] = []
        gui = server.gui
        add = gui.add_button("Add this view", hint="Add the current camera to the path")
        add.on_click(lambda event: None if event.client is None else self.add(event.client.camera))
        gui.add_button("Remove the last view").on_click(lambda _: self.drop())
        self._seconds = gui.add_slider("Seconds", *SECONDS, 0.5, 6.0)
        self._height = gui.add_dropdown("Height", HEIGHTS, initial_value="480")
        self._relight = gui.add_checkbox(
            "Change light from left to right", False, hint="Otherwise the video keeps the current light"
        )
        self._make = gui.add_button("Make the video", disabled=folder is None)
        self._make.on_click(lambda event: self._ordered(event.client))
        self._line = gui.add_html("")
        self.tell(self._describe())

    def add(self, camera: Any) -> None:
        """Adds a key frame unless the path has `MAX_VIEWS`."""
        if len(self._poses) >= MAX_VIEWS:
            self.tell(f"A path has at most {MAX_VIEWS} views.")
            return
        pose = Pose(np.array(camera.wxyz), np.array(camera.position), float(camera.fov), ASPECT)
        self._poses.append(pose)
        marker = self._server.scene.add_camera_frustum(
            f"{PARENT}/{len(self._poses)}",
            fov=pose.fov,
            aspect=pose.aspect,
            scale=MARKER_SIZE,
            thickness=MARKER_SIZE / 30,
            color=COLOR,
            wxyz=pose.wxyz,
            position=pose.position,
        )
        self._markers.append(marker)
        self.tell(self._describe())

    def drop(self) -> None:
        """Removes the last key frame."""
        if self._poses:
            self._poses.pop()
            self._markers.pop().remove()
        self.tell(self._describe())

    def order(self) -> VideoOrder:
        """The settings of the controls; raises `UserError` if there are too few views or the video is too long."""
        if len(self._poses) < MIN_VIEWS:
            raise UserError(
                "a path needs at least two views: add this view, move the camera, and add another one"
            )
        seconds = float(self._seconds.value)
        if self._height.value not in HEIGHTS or not SECONDS[0] <= seconds <= SECONDS[1]:
            raise UserError(
                f"videos are limited to {SECONDS[1]:.0f} seconds and a height of {HEIGHTS[-1]} pixels"
            )
        height = int(self._height.value)
        cameras = tuple(camera_of(pose, height) for pose in self._poses)
        return VideoOrder(cameras, seconds, bool(self._relight.value))

    def tell(self, text: str) -> None:
        """Shows a line below the controls."""
        self._line.content = (
            f'<div style="font-size:12px;margin:2px 12px 8px;overflow-wrap:anywhere">{escape(text)}</div>'
        )

    def _describe(self) -> str:
        if self.folder is None:
            return "Videos are available after training: open the run with wildgs view."
        count = len(self._poses)
        if count < MIN_VIEWS:
            return f"{count} of at least two views. Move the camera and add the view."
        return f"{count} views"


FPS = 30.0


def make_film(
    subject: Subject, desk: LightDesk, order: VideoOrder, file: Path, progress: Callable[[int, int], bool]
) -> Path:
    """Renders a video along the key frames and writes a camera file of the same name (.json).

    Args:
        subject: The scene.
        desk: Its light.
        order: Settings of the video.
        file: The video file.
        progress: Called with (frames done, number of frames) after every frame; False cancels.

    Raises:
        UserError: The video cannot be written or was cancelled; no file is left.
    """
    height = order.keyframes[0].height
    width = 2 * round(height * ASPECT / 2)
    cameras = interpolate(order.keyframes, max(2, round(order.seconds * FPS)), width, height)
    write_frames(file, _frames(subject, desk, order.relight, cameras, progress), (width, height), FPS)
    write_camera_path(file.with_suffix(".json"), cameras, fps=FPS)
    return file


def free_name(folder: Path) -> Path:
    """The next unused name for a video in a folder."""
    number = 1
    while (file := folder / f"path_{number:03d}.mp4").exists():
        number += 1
    return file


def _frames(
    subject: Subject,
    desk: LightDesk,
    relight: bool,
    cameras: list[Camera],
    progress: Callable[[int, int], bool],
) -> Iterator[UInt8[np.ndarray, "H W 3"]]:
    look = desk.look(subject)
    for number, camera in enumerate(cameras):
        if relight:
            look = replace(desk, amount=number / (len(cameras) - 1)).look(subject)
        picture, _ = subject.render(camera, look)
        yield picture.numpy()
        if not progress(number + 1, len(cameras)):
            raise UserError("the video is incomplete, because the viewer was closed")
