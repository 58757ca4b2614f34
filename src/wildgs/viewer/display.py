"""The Gaussians in the browser; their colours are updated when the light or the viewpoint changes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from wildgs.exporters.depth_colors import color_depth
from wildgs.geometry.camera import Camera, quats_to_rotations
from wildgs.light.look import Look
from wildgs.model.gaussians import Gaussians
from wildgs.rasterize import sh_to_colors
from wildgs.rasterize.interface import MIN_ALPHA
from wildgs.viewer.subject import Subject

if TYPE_CHECKING:
    import viser

ENLARGED = 10.0
"""Scale factor of splats, undone by their scene node. Covariances are sent in half precision, which is coarse below
6e-5, while a Gaussian of one pixel at the photos' median depth has a variance of 1e-6."""

_HALF_MAX = 6e4


@dataclass(frozen=True)
class Splats:
    """Geometry for viser, scaled by `ENLARGED`.

    Attributes:
        rows: Indices of the Gaussians; invisible ones are left out.
        means: Centres in the aligned frame on the method's device, for evaluating view-dependent colours.
        centers: Scaled centres.
        covariances: Scaled covariances in world axes.
        opacities: Opacities in [0, 1].
    """

    rows: Int[Tensor, " M"]
    means: Float[Tensor, "M 3"]
    centers: Float[np.ndarray, "M 3"]
    covariances: Float[np.ndarray, "M 3 3"]
    opacities: Float[np.ndarray, "M 1"]

    def __len__(self) -> int:
        return len(self.rows)


@torch.no_grad()
def splats_of(gaussians: Gaussians) -> Splats:
    """Packs all visible Gaussians: finite, and with an opacity of at least 1/255 as in the rasteriser."""
    scales, opacities = gaussians.scales, gaussians.opacities
    finite = gaussians.means.isfinite().all(dim=1) & scales.isfinite().all(dim=1)
    finite &= gaussians.quats.isfinite().all(dim=1)
    rows = (finite & (opacities >= MIN_ALPHA)).nonzero()[:, 0]
    means = gaussians.means[rows].detach().clone()
    axes = quats_to_rotations(gaussians.quats[rows]) * (scales[rows] * ENLARGED)[:, None, :]
    covariances = (axes @ axes.transpose(1, 2)).clamp(-_HALF_MAX, _HALF_MAX)
    return Splats(
        rows=rows,
        means=means,
        centers=(means * ENLARGED).cpu().numpy(),
        covariances=covariances.cpu().numpy(),
        opacities=opacities[rows, None].cpu().numpy(),
    )


@torch.no_grad()
def colors_from(
    means: Float[Tensor, "M 3"], sh: Float[Tensor, "M K 3"], position: Float[Tensor, " 3"], degree: int
) -> Float[np.ndarray, "M 3"]:
    """Colours in [0, 1] of Gaussians seen from a position, by harmonics up to a degree."""
    viewmat = torch.eye(4).to(means)
    viewmat[:3, 3] = -position.to(means)
    camera = Camera(viewmat, torch.eye(3).to(means), 1, 1)
    return sh_to_colors(means, sh, camera, degree=degree).clamp(0, 1).cpu().numpy()


@torch.no_grad()
def distances_from(means: Float[Tensor, "M 3"], position: Float[Tensor, " 3"]) -> Float[np.ndarray, " M"]:
    """Distances of the centres from a position, world units."""
    return (means - position.to(means)).norm(dim=1).cpu().numpy()


Paint = Literal["colour", "depth"]
NODE = "/splats"


class SplatDisplay:
    """Draws a subject's Gaussians in all clients.

    viser's splats have one colour each, so view-dependent colours are evaluated for the position of the camera that
    moved last.

    Attributes:
        eye: The position for which colours are evaluated, in the aligned frame.
        paint: Whether splats show colour or depth.
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
        """Draws all Gaussians under a look of the subject's current state."""
        if self._splats is None or self._version != self._subject.version:
            self._version = self._subject.version
            self._splats = splats_of(self._subject.method.gaussians)
        self._sh = look.sh[self._splats.rows]
        self.repaint()

    def repaint(self) -> None:
        """Evaluates the colours for `eye` and sends them; the subject may have changed since `show`."""
        if self._splats is None or self._sh is None:
            return
        colors = self._colors(self._splats, self._sh)
        splats = self._splats
        arguments: dict[str, Any] = {
            "centers": splats.centers,
            "covariances": splats.covariances,
            "rgbs": colors,
            "opacities": splats.opacities,
        }
        if self._handle is None:
            self._handle = self._server.scene.add_gaussian_splats(NODE, **arguments, scale=1 / ENLARGED)
        else:
            self._handle.set_gaussians(**arguments)

    def _colors(self, splats: Splats, sh: Float[Tensor, "M K 3"]) -> Float[np.ndarray, "M 3"]:
        if self.paint == "depth":
            distances = distances_from(splats.means, self.eye)
            return color_depth(distances[None].astype(np.float64))[0] / 255
        return colors_from(splats.means, sh, self.eye, self._subject.sh_degree)
