"""What every rasteriser backend takes and gives.

Rasterisation is split in two, so that geometry work is done once and blended several times:
`project` (projection, tile binning, depth order) and `blend` (front-to-back compositing of any channels).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

from jaxtyping import Bool, Float, Int
from torch import Tensor

from wildgs.geometry.camera import Camera

BackendName = Literal["cpu", "cuda", "reference"]

TILE = 16  # pixels along a tile's side
EPS2D = 0.3  # px^2 added to the 2D covariance's diagonal, gsplat's default: nothing is thinner than a pixel
MIN_ALPHA = 1.0 / 255.0  # a Gaussian is dropped at a pixel where its alpha is below
MAX_ALPHA = 0.999
MIN_TRANSMITTANCE = 1e-4  # a Gaussian that would leave no more light than this ends the pixel and is dropped


@dataclass
class Projection:
    """Gaussians as one camera sees them, with the backend's tile lists.

    Attributes:
        camera: The camera.
        means2d: Projected centres in pixels. Differentiable; call `means2d.retain_grad()` before `blend` to read
            the screen gradient after the backward pass (densification).
        depths: Camera-space z of the centres, world units. Differentiable.
        conics: Inverse of the dilated 2D covariances (xx, xy, yy), in 1/pixel^2. Differentiable.
        opacities: As given. Differentiable.
        radii: Reach in pixels, rounded up: where alpha falls to 1/255 along the wider image axis (gsplat 1.5's
            opacity-aware radius, its larger one); 0 where the Gaussian is not seen (culled).
        backend: Which backend made it, and must blend it.
        tiles: The backend's own tile lists, opaque to callers.
        absgrad: Where `blend`'s backward pass adds |d loss / d means2d| per pixel, summed (gsplat's `absgrad`);
            None unless asked for.
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
        """Which Gaussians reach the picture."""
        return self.radii > 0


@dataclass
class Rendering:
    """A blended picture, or some pixels of one.

    Attributes:
        colors: Σ c_i α'_i T_i (+ background · (1 - alpha)).
        depth: Expected depth Σ d_i α'_i T_i / alpha in world units (gsplat's "ED"); 0 where alpha is 0, and
            everywhere if `blend` was told to leave depth out.
        alpha: Σ α'_i T_i in [0, 1].
    """

    colors: Float[Tensor, "*pixels C"]
    depth: Float[Tensor, "*pixels"]
    alpha: Float[Tensor, "*pixels"]

    def detached(self) -> Rendering:
        """The same picture without its autograd graph."""
        return Rendering(self.colors.detach(), self.depth.detach(), self.alpha.detach())
