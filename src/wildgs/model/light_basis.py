"""Light basis: principal components of the training photos' lights, in which a photo's light is fitted.

Not in the paper. The networks predict a photo's light in one pass, and most of the remaining error is of low
frequency: light, not structure. The lights of a collection (position of the sun, clouds, lamps) vary mostly along a
few directions in the space of all Gaussians' harmonics, their principal components. Fitting a photo in this basis
is a linear least-squares problem, as in the morphable models of Blanz and Vetter (1999).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from wildgs.geometry.spherical_harmonics import sh_values
from wildgs.model.appearance import Appearance
from wildgs.model.gaussians import Gaussians
from wildgs.model.method import Method
from wildgs.model.photo_match import Sight
from wildgs.model.wrapping import liftable
from wildgs.rasterize import Projection, blend

MOST_LIGHTS = 96
"""Upper bound on the number of photos whose lights are used, an even selection of larger collections."""
LIGHTS_BYTES, BASIS_BYTES = 2**31, 2**29
"""Limits of the memory for all lights while the basis is computed, and for the basis."""
RIDGE = 5e-6
"""Ridge regularisation, per squared standard deviation of the training photos along a component."""
OUTLIER = 0.1
"""Residual at which a pixel's weight is halved (Cauchy weights)."""
ROUNDS = 4
LEAST_PIXELS = 64
"""Smallest number of pixels for a fit."""
ROWS_AT_ONCE = 65_536
BLENDED_AT_ONCE = 8
"""Components per blend, whose blending weights are computed once for all channels."""


class LightBasis(nn.Module):
    """Principal components of the harmonics of all Gaussians over the training photos.

    Attributes:
        components: B components of one standard deviation each, in half precision; None before `learn`.
    """

    components: Float[Tensor, "B N K 3"] | None

    def __init__(self) -> None:
        """Creates an empty basis."""
        super().__init__()
        self.register_buffer("components", None)

    @staticmethod
    def affordable_lights(count: int, harmonics: int) -> int:
        """Number of lights of `count` Gaussians, with `harmonics` per channel, that fit into `LIGHTS_BYTES`."""
        return min(MOST_LIGHTS, LIGHTS_BYTES // (6 * harmonics * max(count, 1)))

    @torch.no_grad()
    def learn(self, lights: Iterable[Float[Tensor, "N K 3"]], gaussians: Gaussians, size: int) -> None:
        """Computes the principal components of lights; fewer than three lights give none.

        Args:
            lights: Harmonics of all Gaussians under the light of each photo.
            gaussians: The Gaussians, which are weighted by their visibility.
            size: Number of components, B; reduced if they do not fit into `BASIS_BYTES`.
        """
        self.components = None
        stacked = [light.half() for light in lights]
        if len(stacked) < 3:
            return
        values = torch.stack(stacked)
        values -= values.float().mean(dim=0).half()
        size = min(size, len(values) - 1, BASIS_BYTES // values[0].nbytes)
        if size < 1:
            return
        gram = torch.zeros(len(values), len(values), dtype=torch.float64, device=values.device)
        parts = list(
            zip(values.split(ROWS_AT_ONCE, 1), _importance(gaussians).split(ROWS_AT_ONCE), strict=True)
        )
        for part, weight in parts:
            weighted = (part.float() * weight.sqrt()[:, None, None]).flatten(1)
            gram += (weighted @ weighted.T).double()
        _, vectors = torch.linalg.eigh(gram)
        mixing = vectors.flip(1)[:, :size].T.float() / len(values) ** 0.5
        parts = [torch.einsum("bt, tnkc -> bnkc", mixing, part.float()).half() for part, _ in parts]
        self.components = torch.cat(parts, dim=1)

    def harmonics(
        self, weights: Float[Tensor, " B"], rows: Int[Tensor, " V"] | None = None
    ) -> Float[Tensor, "N K 3"]:
        """The weighted sum of the components for the given Gaussians (None: for all)."""
        assert self.components is not None
        chosen = self.components if rows is None else self.components[:, rows]
        return (weights.to(chosen.dtype) @ chosen.flatten(1)).float().reshape(chosen.shape[1:])

    @torch.no_grad()
    def fit(self, method: Method, sight: Sight, appearance: Appearance) -> Appearance:
        """Adds the weights with which the render under an appearance best matches the photo.

        Robust ridge regression; its prior is the variation among the training photos.

        Args:
            method: The method, for shading and rendering.
            sight: The photo.
            appearance: The appearance predicted by the networks.
        """
        if self.components is None:
            return appearance
        projection, visibility = sight.projection, sight.visibility
        colors = method.paint(projection, appearance, method.sh_degree, clamped=False)
        rendering = blend(projection, colors)
        counts = liftable(visibility, rendering.alpha, method.mask_threshold).float()
        if visibility is not None:
            counts = counts * visibility
        if sight.keep is not None:
            counts = counts * sight.keep
        if int((counts > 0).sum()) < LEAST_PIXELS:
            return appearance
        residual = sight.photo - rendering.colors.clamp(max=1)
        images = self._images(projection, method.gaussians.means)
        return replace(appearance, basis_weights=fit_weights(images, residual, counts))

    def _images(self, projection: Projection, means: Float[Tensor, "N 3"]) -> Float[Tensor, "B H W 3"]:
        """Renders the components, `BLENDED_AT_ONCE` at a time."""
        assert self.components is not None
        rows = projection.visible.nonzero()[:, 0]
        towards = means[rows] - projection.camera.position
        pictures = []
        for part in self.components.split(BLENDED_AT_ONCE):
            seen = sh_values(part[:, rows].permute(1, 2, 0, 3).flatten(2).float(), towards)
            colors = means.new_zeros(len(means), seen.shape[1]).index_copy(0, rows, seen)
            blended = blend(projection, colors, depth=False).colors
            pictures += blended.split(3, dim=2)
        return torch.stack(pictures)


@torch.no_grad()
def fit_weights(
    images: Float[Tensor, "B H W 3"], residual: Float[Tensor, "H W 3"], counts: Float[Tensor, "H W"]
) -> Float[Tensor, " B"]:
    """Weights of images whose sum best matches a residual, by robust ridge regression.

    Args:
        images: Renders of the components.
        residual: Photo minus render.
        counts: Weight of each pixel, 0 or more.
    """
    chosen = counts > 0
    terms, target, base = images[:, chosen], residual[chosen], counts[chosen]
    ridge = RIDGE * torch.eye(len(terms), dtype=torch.float64, device=terms.device)
    weights, trusted = terms.new_zeros(len(terms)), base
    for _ in range(ROUNDS):
        root = (trusted / trusted.sum()).sqrt()[:, None]
        weighted = (terms * root).flatten(1)
        right = weighted @ (target * root).flatten()
        found = torch.linalg.solve((weighted @ weighted.T).double() + ridge, right.double()).float()
        if not found.isfinite().all():
            break
        weights = found
        error = (target - torch.einsum("b, bpc -> pc", weights, terms)).abs().mean(dim=1)
        trusted = base * OUTLIER**2 / (OUTLIER**2 + error.square())
    return weights


def _importance(gaussians: Gaussians) -> Float[Tensor, " N"]:
    """Relative visibility of each Gaussian: opacity times solid angle from the scene's centre."""
    largest = gaussians.scales.topk(2, dim=-1).values.prod(dim=-1)
    distance = (gaussians.means - gaussians.means.median(dim=0).values).norm(dim=-1).clamp_min(1)
    seen = gaussians.opacities * largest / distance.square()
    seen = seen.clamp_max(float(seen[:: 1 + len(seen) // 100_000].quantile(0.99)))
    return seen / seen.sum()
