"""The lights of the training photos as a basis, in which the light of a photo is fitted in closed form.

Not in the paper. The networks guess a photo's light in one pass, and most of the error that remains is of low
frequency: light, not structure. What the lights of a collection have in common (the sun moves, clouds close, lamps
go on) are a few directions in the space of all Gaussians' harmonics: their principal components. How far a photo
lies along each of them is a linear least-squares problem, as in the morphable models of Blanz and Vetter 1999.
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
"""Photos whose lights are looked at; of larger collections as many, evenly spread."""
LIGHTS_BYTES, BASIS_BYTES = 2**31, 2**29
"""Limits of all lights while the basis is learnt, and of the basis that is kept."""
RIDGE = 5e-6
"""Of the least squares, per squared standard deviation of the training photos along a component."""
OUTLIER = 0.1
"""Residual at which a pixel counts half (Cauchy's weights)."""
ROUNDS = 4
LEAST_PIXELS = 64
"""Fewer say nothing about a photo's light."""
ROWS_AT_ONCE = 65_536


class LightBasis(nn.Module):
    """Principal components of the harmonics of all Gaussians over the training photos.

    Attributes:
        components: B, N Gaussians, K harmonics, RGB, each scaled to one standard deviation, in half precision; None
            until `learn`.
    """

    components: Float[Tensor, "B N K 3"] | None

    def __init__(self) -> None:
        """Sets up an empty `LightBasis`."""
        super().__init__()
        self.register_buffer("components", None)

    @staticmethod
    def affordable_lights(count: int, harmonics: int) -> int:
        """How many lights of `count` Gaussians' `harmonics` (per channel) fit into `LIGHTS_BYTES`."""
        return min(MOST_LIGHTS, LIGHTS_BYTES // (6 * harmonics * max(count, 1)))

    @torch.no_grad()
    def learn(self, lights: Iterable[Float[Tensor, "N K 3"]], gaussians: Gaussians, size: int) -> None:
        """Replaces the components by those of some lights; fewer than three lights leave none.

        Args:
            lights: Harmonics of all Gaussians under the light of one photo each.
            gaussians: Which of them count how much.
            size: Number of components, B; less where `BASIS_BYTES` do not hold as many.
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
        """What weights add to the harmonics of the given Gaussians (None: of all)."""
        assert self.components is not None
        chosen = self.components if rows is None else self.components[:, rows]
        return (weights.to(chosen.dtype) @ chosen.flatten(1)).float().reshape(chosen.shape[1:])

    @torch.no_grad()
    def fit(self, method: Method, sight: Sight, appearance: Appearance) -> Appearance:
        """Adds the weights that bring the render under an appearance nearest to the photo.

        Robust ridge regression: its prior is that a photo's light differs from the guess by no more than training
        photos differ from one another.

        Args:
            method: Shades and renders.
            sight: The photo.
            appearance: The guess.
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
        """Pictures of the components."""
        assert self.components is not None
        rows = projection.visible.nonzero()[:, 0]
        towards = means[rows] - projection.camera.position
        pictures = []
        for component in self.components:
            seen = sh_values(component[rows].float(), towards)
            colors = torch.zeros_like(means).index_copy(0, rows, seen)
            pictures.append(blend(projection, colors, depth=False).colors)
        return torch.stack(pictures)


@torch.no_grad()
def fit_weights(
    images: Float[Tensor, "B H W 3"], residual: Float[Tensor, "H W 3"], counts: Float[Tensor, "H W"]
) -> Float[Tensor, " B"]:
    """Weights of pictures whose sum is nearest to a residual, by robust ridge regression.

    Args:
        images: One standard deviation along each component.
        residual: Photo less render.
        counts: How much each pixel counts, 0 or more.
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
    """Share of each Gaussian in what there is to see: opacity by the solid angle from the middle of the scene."""
    largest = gaussians.scales.topk(2, dim=-1).values.prod(dim=-1)
    distance = (gaussians.means - gaussians.means.median(dim=0).values).norm(dim=-1).clamp_min(1)
    seen = gaussians.opacities * largest / distance.square()
    seen = seen.clamp_max(float(seen[:: 1 + len(seen) // 100_000].quantile(0.99)))
    return seen / seen.sum()
