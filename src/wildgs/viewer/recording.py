"""A path through the scene: views are added one by one, the way between them is smooth, a video is made of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from wildgs.errors import UserError
from wildgs.geometry.camera import Camera
from wildgs.viewer.cameras import Pose, ViserCamera, camera_of
from wildgs.viewer.markup import escape

if TYPE_CHECKING:
    import viser

PARENT = "/path"
HEIGHTS = ("360", "480", "720", "1080")
ASPECT = 16 / 9
LEAST_VIEWS = 2
COLOR = (77, 171, 247)
MARKER_SIZE = 0.04


@dataclass(frozen=True)
class VideoOrder:
    """What a video shall be.

    Attributes:
        keyframes: Views on the way, at least two.
        seconds: Its length.
        relight: Whether the light goes from the left one to the right one on the way.
    """

    keyframes: tuple[Camera, ...]
    seconds: float
    relight: bool


class RecordingPanel:
    """The controls of a path, and its views as frustums in the scene.

    Attributes:
        folder: Where videos go.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        folder: Path | None,
        ordered: Callable[[viser.ClientHandle | None], None],
    ) -> None:
        """Adds the controls to the container that is open.

        Args:
            server: The viewer's.
            folder: Where videos go; None while there can be none (training).
            ordered: Called, on a thread of viser's, with the browser that wants the video.
        """
        self.folder = folder
        self._server, self._ordered = server, ordered
        self._poses: list[Pose] = []
        self._markers: list[viser.CameraFrustumHandle] = []
        gui = server.gui
        add = gui.add_button(
            "Add this view", hint="The camera where it is now becomes the next view of the path"
        )
        add.on_click(lambda event: None if event.client is None else self.add(event.client.camera))
        gui.add_button("Take the last one away").on_click(lambda _: self.drop())
        self._seconds = gui.add_slider("Seconds", 1.0, 60.0, 0.5, 6.0)
        self._height = gui.add_dropdown("Height", HEIGHTS, initial_value="480")
        self._relight = gui.add_checkbox(
            "Light goes from left to right", False, hint="Otherwise it stays as it is shown"
        )
        self._make = gui.add_button("Make the video", disabled=folder is None)
        self._make.on_click(lambda event: self._ordered(event.client))
        self._line = gui.add_html("")
        self.tell(self._describe())

    def add(self, camera: ViserCamera) -> None:
        """The next view of the path."""
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
        """Forgets the last view."""
        if self._poses:
            self._poses.pop()
            self._markers.pop().remove()
        self.tell(self._describe())

    def order(self) -> VideoOrder:
        """What was asked for.

        Raises:
            UserError: A path needs more views.
        """
        if len(self._poses) < LEAST_VIEWS:
            raise UserError("a path needs two views or more: fly somewhere, add the view, and again")
        height = int(self._height.value)
        cameras = tuple(camera_of(pose, height) for pose in self._poses)
        return VideoOrder(cameras, float(self._seconds.value), bool(self._relight.value))

    def tell(self, text: str) -> None:
        """Shows a line below the controls."""
        self._line.content = (
            f'<div style="font-size:12px;margin:2px 12px 8px;overflow-wrap:anywhere">{escape(text)}</div>'
        )

    def _describe(self) -> str:
        if self.folder is None:
            return "Videos can be made once training is done: open the run with wildgs view."
        count = len(self._poses)
        if count < LEAST_VIEWS:
            return f"{count} of at least two views. Fly somewhere and add the view."
        return f"{count} views"
