"""The splats in the browser: put there once, repainted when the light or the eye changes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from wildgs.export.depth_colors import color_depth
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
        self._look: Look | None = None

    def show(self, look: Look) -> None:
        """Draws all Gaussians under a light; looks at their geometry anew only where it is another model's state."""
        if self._splats is None:
            self._splats = splats_of(self._subject.method.gaussians)
        self._look = look
        self.repaint()

    def forget_geometry(self) -> None:
        """Takes the Gaussians anew at the next `show`: they have been trained on."""
        self._splats = None
        self._look = None

    def repaint(self) -> None:
        """Evaluates colours for the eye and sends them."""
        if self._splats is None or self._look is None:
            return
        colors = self._colors(self._splats, self._look)
        arguments = as_viser(self._splats, colors)
        if self._handle is None:
            self._handle = self._server.scene.add_gaussian_splats(NODE, **arguments, scale=1 / ENLARGED)
        else:
            self._handle.set_gaussians(**arguments)

    def _colors(self, splats: Splats, look: Look) -> Float[np.ndarray, "M 3"]:
        if self.paint == "depth":
            distances = distances_from(splats.means, self.eye)
            return color_depth(distances[None].astype(np.float64))[0] / 255
        with torch.no_grad():
            sh = look.sh[splats.rows]
        return colors_from(splats.means, sh, self.eye, self._subject.sh_degree)
