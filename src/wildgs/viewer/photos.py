"""The photos in the scene: frustums, viewpoints, and comparisons of a photo with its render, mask and depth."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from wildgs.evaluation.metrics import psnr
from wildgs.exporters.depth_colors import color_depth, tint_hidden
from wildgs.files import printable
from wildgs.light.look import Look
from wildgs.scene import View
from wildgs.viewer.cameras import fov_that_holds, pose_of
from wildgs.viewer.gallery import Gallery
from wildgs.viewer.markup import figures
from wildgs.viewer.subject import Subject

if TYPE_CHECKING:
    import viser

LONG_SIDE = 480
"""Longer side of the images in pixels."""

Picture = UInt8[np.ndarray, "H W 3"]


@dataclass(frozen=True)
class Comparison:
    """Images of one viewpoint, all of the same size.

    Attributes:
        name: Name of the photo.
        photo: The photo.
        render: Render of its viewpoint.
        mask: The photo with transient pixels in red; None without a mask.
        depth: Rendered depth; near is bright.
        psnr: PSNR of the render against the whole photo including transients, dB.
        light: Name of the render's light.
    """

    name: str
    photo: Picture
    render: Picture
    mask: Picture | None
    depth: Picture
    psnr: float
    light: str


@torch.no_grad()
def compare(subject: Subject, view: View, look: Look) -> Comparison:
    """Renders a photo's viewpoint under a light."""
    shrink = min(1.0, LONG_SIDE / max(view.camera.width, view.camera.height))
    width, height = (max(1, round(side * shrink)) for side in (view.camera.width, view.camera.height))
    pixels = _resized(view.read_photo().permute(2, 0, 1).float(), width, height)
    photo = pixels.permute(1, 2, 0).round().clamp(0, 255).to(torch.uint8)
    render, rendering = subject.render(view.camera.resized(width, height), look)
    depth = torch.where(rendering.alpha > 0.5, rendering.depth, 0.0)
    visibility = subject.visibility(view)
    if visibility is not None:
        visibility = _resized(visibility[None], width, height)[0]
    return Comparison(
        name=view.name,
        photo=photo.numpy(),
        render=render.numpy(),
        mask=None if visibility is None else tint_hidden(photo.numpy(), visibility.numpy()),
        depth=color_depth(depth.double().cpu().numpy()),
        psnr=psnr(render, photo),
        light=look.name,
    )


def _resized(channels: Float[Tensor, "C H W"], width: int, height: int) -> Float[Tensor, "C h w"]:
    options = {"mode": "bilinear", "antialias": True}
    return torch.nn.functional.interpolate(channels[None], (height, width), **options)[0]


PARENT = "/photos"
FRUSTUM_SIZE = 0.06
"""Size of a frustum, relative to the photos' median depth."""
LINE = 0.0012
COLORS = {"train": (250, 176, 5), "test": (81, 207, 102)}
NO_PHOTO = "choose…"


class PhotoPanel:
    """Frustums and their controls, and the comparison of a photo with its render."""

    def __init__(
        self,
        server: viser.ViserServer,
        views: tuple[View, ...],
        gallery: Gallery,
        visited: Callable[[View], None],
    ) -> None:
        """Adds the controls to the open container.

        Args:
            server: The viewer's server.
            views: All photos.
            gallery: Photos with frustums.
            visited: Called on a thread of viser when a client moves to a photo's viewpoint.
        """
        self._server, self._gallery, self._visited = server, gallery, visited
        self._by_label = {printable(view.name): view for view in views}
        self.current: View | None = None
        self._frustums: dict[str, viser.CameraFrustumHandle] = {}
        self._shown: dict[str, np.ndarray] = {}
        gui = server.gui
        # Initially hidden, because frustums of other photos block the view from a photo's viewpoint.
        self.parent = server.scene.add_frame(PARENT, show_axes=False, visible=False)
        shown = gui.add_checkbox(
            "Show cameras", False, hint="Show the cameras of the photos; click on one to move there"
        )
        shown.on_update(lambda _: setattr(self.parent, "visible", shown.value))
        self._choice = gui.add_dropdown("Go to photo", (NO_PHOTO, *self._by_label), initial_value=NO_PHOTO)
        self._choice.on_update(self._chosen)
        self.own_light = gui.add_checkbox(
            "Use the photo's light",
            True,
            hint="Otherwise the photo's viewpoint is rendered under the current light",
        )
        self.own_light.on_update(lambda _: self._revisit())
        self._pictures = gui.add_html(
            '<div style="font-size:12px;opacity:.75;margin:2px 12px 8px">Choose a photo above, or click its camera '
            "in the scene, to move to its viewpoint. Photo, render, mask and depth appear here.</div>"
        )
        gallery.on_change(self.refresh)
        self.refresh()

    def refresh(self) -> None:
        """Adds frustums for photos whose thumbnails are loaded, and updates changed thumbnails."""
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
                # A number, because slashes in names of nodes create a hierarchy.
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
        """Moves a client's camera to a photo's viewpoint and requests the comparison."""
        if client is not None:
            stand_at(client, view)
        self.current = view
        if self._choice.value != printable(view.name):
            self._choice.value = printable(view.name)
        self._visited(view)

    def show(self, comparison: Comparison) -> None:
        """Shows the images of the current photo's viewpoint."""
        pictures = [("photo", comparison.photo), ("render", comparison.render)]
        if comparison.mask is not None:
            pictures.append(("mask: red is transient", comparison.mask))
        pictures.append(("depth: near is bright", comparison.depth))
        note = f"{comparison.name}, lit by {comparison.light}: {comparison.psnr:.1f} dB, including passers-by"
        self._pictures.content = figures(pictures, note)

    def _chosen(self, event: viser.GuiEvent) -> None:
        view = self._by_label.get(self._choice.value)
        if view is not None and (self.current is None or view.name != self.current.name):
            self.visit(event.client, view)

    def _revisit(self) -> None:
        if self.current is not None:
            self._visited(self.current)


def stand_at(client: viser.ClientHandle, view: View) -> None:
    """Moves a client's camera to that of a photo, with a field of view that shows the whole photo."""
    pose = pose_of(view.camera)
    with client.atomic():
        client.camera.position = pose.position
        client.camera.wxyz = pose.wxyz
        client.camera.fov = min(fov_that_holds(pose, client.camera.aspect), math.radians(150))
