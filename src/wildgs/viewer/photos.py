"""The photos in space: a frustum where each was taken, a click to stand there, and what the model makes of it."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from wildgs.files import printable
from wildgs.scene import View
from wildgs.viewer.cameras import fov_that_holds, pose_of
from wildgs.viewer.comparison import Comparison
from wildgs.viewer.gallery import Gallery
from wildgs.viewer.markup import figures

if TYPE_CHECKING:
    import viser

PARENT = "/photos"
FRUSTUM_SIZE = 0.06
"""Of a frustum, in the photos' usual depth."""
LINE = 0.0012
COLORS = {"train": (250, 176, 5), "test": (81, 207, 102)}
NO_PHOTO = "choose…"


class PhotoPanel:
    """Frustums and their controls, and a window with a photo beside its render."""

    def __init__(
        self,
        server: viser.ViserServer,
        views: tuple[View, ...],
        gallery: Gallery,
        visited: Callable[[View], None],
    ) -> None:
        """Adds the controls to the container that is open.

        Args:
            server: The viewer's.
            views: All photos.
            gallery: Those that get frustums.
            visited: Called, on a thread of viser's, when someone stands at a photo's viewpoint.
        """
        self._server, self._gallery, self._visited = server, gallery, visited
        self._by_label = {printable(view.name): view for view in views}
        self.current: View | None = None
        self._frustums: dict[str, viser.CameraFrustumHandle] = {}
        self._shown: dict[str, np.ndarray] = {}
        gui = server.gui
        # Not shown at first: at a photo's viewpoint, the photos of others stand in the way.
        self.parent = server.scene.add_frame(PARENT, show_axes=False, visible=False)
        shown = gui.add_checkbox(
            "Show cameras", False, hint="Where photos were taken; a click on one goes there"
        )
        shown.on_update(lambda _: setattr(self.parent, "visible", shown.value))
        self._choice = gui.add_dropdown("Go to photo", (NO_PHOTO, *self._by_label), initial_value=NO_PHOTO)
        self._choice.on_update(self._chosen)
        self.own_light = gui.add_checkbox(
            "Under its own light",
            True,
            hint="Otherwise the render is under the light that the scene is shown in",
        )
        self.own_light.on_update(lambda _: self._revisit())
        self._pictures = gui.add_html(
            '<div style="font-size:12px;opacity:.75;margin:2px 12px 8px">Choose a photo above, or click its camera '
            "in the scene, to stand where it was taken. Photo, render, mask and depth appear here.</div>"
        )
        gallery.on_change(self.refresh)
        self.refresh()

    def refresh(self) -> None:
        """Adds frustums for the photos whose thumbnails are there, and shows those that changed."""
        for view in self._gallery.views:
            picture = self._gallery.picture(view.name)
            if picture is None or picture is self._shown.get(view.name):
                continue
            self._shown[view.name] = picture
            if view.name in self._frustums:
                self._frustums[view.name].image = picture
                continue
            pose = pose_of(view.camera)
            frustum = self._server.scene.add_camera_frustum(
                # Names of nodes make a tree at every slash; a number is safe whatever the photo is called.
                f"{PARENT}/{len(self._frustums)}",
                fov=pose.fov,
                aspect=pose.aspect,
                scale=FRUSTUM_SIZE,
                thickness=LINE,
                color=COLORS[view.split],
                image=picture,
                wxyz=pose.wxyz,
                position=pose.position,
            )
            frustum.on_click(lambda event, view=view: self.visit(event.client, view))
            self._frustums[view.name] = frustum

    def visit(self, client: viser.ClientHandle | None, view: View) -> None:
        """Puts a browser's camera where a photo was taken, and has the two compared."""
        if client is not None:
            stand_at(client, view)
        self.current = view
        if self._choice.value != printable(view.name):
            self._choice.value = printable(view.name)
        self._visited(view)

    def show(self, comparison: Comparison) -> None:
        """Shows pictures of the current photo's viewpoint."""
        pictures = [("photo", comparison.photo), ("render", comparison.render)]
        if comparison.mask is not None:
            pictures.append(("mask: red is transient", comparison.mask))
        pictures.append(("depth: near is bright", comparison.depth))
        note = f"{comparison.name}, lit by {comparison.light}: {comparison.psnr:.1f} dB, passers-by included"
        self._pictures.content = figures(pictures, note)

    def _chosen(self, event: viser.GuiEvent) -> None:
        view = self._by_label.get(self._choice.value)
        if view is not None and (self.current is None or view.name != self.current.name):
            self.visit(event.client, view)

    def _revisit(self) -> None:
        if self.current is not None:
            self._visited(self.current)


def stand_at(client: viser.ClientHandle, view: View) -> None:
    """Moves a browser's camera to a photo's, opened so far that the whole photo is in the window."""
    pose = pose_of(view.camera)
    with client.atomic():
        client.camera.position = pose.position
        client.camera.wxyz = pose.wxyz
        client.camera.fov = min(fov_that_holds(pose, client.camera.aspect), math.radians(150))
