"""Inputs and outputs of the rasteriser backends.

Rasterisation is split in two, so that one projection can be blended several times: `project` (projection, tile
binning, depth sorting) and `blend` (front-to-back alpha blending of any channels).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

from jaxtyping import Bool, Float, Int
from torch import Tensor

from wildgs.geometry.camera import Camera

BackendName = Literal["cpu", "cuda", "reference"]

TILE = 16  # side of a tile in pixels
EPS2D = (
    0.3  # px^2 added to the diagonal of 2D covariances, gsplat's default: a low-pass filter of about a pixel
)
MIN_ALPHA = 1.0 / 255.0  # Gaussians with a lower alpha at a pixel are skipped there
MAX_ALPHA = 0.999
MIN_TRANSMITTANCE = 1e-4  # blending of a pixel stops before the Gaussian that would leave no more than this


@dataclass
class Projection:
    """Gaussians projected into a camera, with the backend's tile lists.

    Attributes:
        camera: The camera.
        means2d: Projected centres in pixels. Differentiable; call `means2d.retain_grad()` before `blend` to read
            the screen gradient after the backward pass (densification).
        depths: Camera-space z of the centres, world units. Differentiable.
        conics: Inverse of the dilated 2D covariances (xx, xy, yy), in 1/pixel^2. Differentiable.
        opacities: As passed to `project`, times the compensation if it is antialiased. Differentiable.
        radii: Radii in pixels, rounded up, at which alpha falls to 1/255 along the wider image axis (the larger of
            gsplat 1.5's opacity-aware radii); 0 for culled Gaussians.
        backend: The backend that made the projection and must blend it.
        tiles: The backend's tile lists, opaque to callers.
        absgrad: Buffer to which `blend`'s backward pass adds the sum of |d loss / d means2d| over pixels (gsplat's
            `absgrad`); None unless requested.
    """

    camera: Camera
    means2d: Float[Tensor, "N 2"]
    depths: Float[Tensor, "N"]
    conics: Float[Tensor, "N 3"]
    opacities: Float[Tensor, "N"]
    radii: Int[Tensor, "N"]
    backend: BackendName
    tiles: Any = field(repr=False)
    absgrad: Float[Tensor, "N 2"] | None = None

    @property
    def visible(self) -> Bool[Tensor, "N"]:
        """Mask of Gaussians that are not culled."""
        return self.radii > 0


@dataclass
class Rendering:
    """A rendered image, or some of its pixels.

    Attributes:
        colors: Σ c_i α'_i T_i (+ background · (1 - alpha)).
        depth: Expected depth Σ d_i α'_i T_i / alpha in world units (gsplat's "ED"); 0 where alpha is 0, and
            everywhere if `blend` was called with ``depth=False``.
        alpha: Σ α'_i T_i in [0, 1].
    """

    colors: Float[Tensor, "*pixels C"]
    depth: Float[Tensor, "*pixels"]
    alpha: Float[Tensor, "*pixels"]

    def detached(self) -> Rendering:
        """The rendering, detached from the autograd graph."""
        return Rendering(self.colors.detach(), self.depth.detach(), self.alpha.detach())
