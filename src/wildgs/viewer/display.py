"""The splats in the browser: put there once, repainted when the light or the eye changes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from wildgs.exporters.depth_colors import color_depth
from wildgs.light.look import Look
from wildgs.viewer.splats import ENLARGED, Splats, as_viser, colors_from, distances_from, splats_of
from wildgs.viewer.subject import Subject

if TYPE_CHECKING:
    import viser

Paint = Literal["colour", "depth"]
NODE = "/splats"


class SplatDisplay:
    """Draws a subject's Gaussians in all browsers that look.

    viser's splats have one colour each, our Gaussians' colours depend on the direction. They are evaluated for one
    eye, the camera that moved last, and are exact there whatever way it turns.

    Attributes:
        eye: The place for which colours are evaluated, aligned frame.
        paint: What colours show.
    """

    def __init__(self, server: viser.ViserServer, subject: Subject, eye: Float[Tensor, " 3"]) -> None:
        self.eye = eye
        self.paint: Paint = "colour"
        self._server = server
        self._subject = subject
        self._splats: Splats | None = None
        self._handle: viser.GaussianSplatHandle | None = None
        self._sh: Float[Tensor, "M K 3"] | None = None
        self._version: int | None = None

    @torch.no_grad()
    def show(self, look: Look) -> None:
        """Draws all Gaussians under a light of the subject's present state."""
        if self._splats is None or self._version != self._subject.version:
            self._version = self._subject.version
            self._splats = splats_of(self._subject.method.gaussians)
        self._sh = look.sh[self._splats.rows]
        self.repaint()

    def repaint(self) -> None:
        """Evaluates colours for the eye and sends them; the subject may have changed since `show`."""
        if self._splats is None or self._sh is None:
            return
        colors = self._colors(self._splats, self._sh)
        arguments = as_viser(self._splats, colors)
        if self._handle is None:
            self._handle = self._server.scene.add_gaussian_splats(NODE, **arguments, scale=1 / ENLARGED)
        else:
            self._handle.set_gaussians(**arguments)

    def _colors(self, splats: Splats, sh: Float[Tensor, "M K 3"]) -> Float[np.ndarray, "M 3"]:
        if self.paint == "depth":
            distances = distances_from(splats.means, self.eye)
            return color_depth(distances[None].astype(np.float64))[0] / 255
        return colors_from(splats.means, sh, self.eye, self._subject.sh_degree)
