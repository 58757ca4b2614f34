"""3D Gaussian Splatting as Markov Chain Monte Carlo (Kheradmand et al. 2024): relocation, noise and a fixed budget.

Gaussians are samples of a distribution. Dead ones (transparent) are relocated to others, which are drawn by their
opacity, so that the render hardly changes; noise on the centres of nearly transparent Gaussians explores the space;
and small penalties on opacities and scales make unneeded Gaussians disappear. The semantics and default values are
those of gsplat's `MCMCStrategy`.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from wildgs.devices import upload
from wildgs.engine.density.control import DensityControl, DensityReport, SeenView, ViewStatistics
from wildgs.engine.optimizers import edit_rows
from wildgs.geometry.camera import quats_to_rotations
from wildgs.model.gaussians import Gaussians

GROWTH = 1.05
"""Largest factor of the number of Gaussians per round."""
MOST_COPIES = 51
"""Upper bound on the number of Gaussians that share one's place, for which the binomial sums are computed."""
STEEPNESS, MOST_NOISE = 100.0, 0.005
"""Steepness of the logistic function by which noise falls with opacity, and the opacity at which it is half."""


class McmcDensity(DensityControl):
    """Relocates transparent Gaussians, adds Gaussians up to the budget, and perturbs centres after every step."""

    resets = False
    until = 25 / 30
    perturbs = True

    def measures(self, step: int) -> bool:
        """False: opacities alone decide."""
        return False

    def measure(self, view: SeenView, sound: Bool[Tensor, ""] | None = None) -> ViewStatistics:
        """No statistics: zeros."""
        zeros = torch.zeros_like(view.projection.radii)
        return ViewStatistics(zeros, zeros, zeros)

    def regularizer(
        self, gaussians: Gaussians, growable: Bool[Tensor, "N"] | None = None
    ) -> Float[Tensor, ""]:
        """Weighted means of opacities and scales over the Gaussians that may be relocated."""
        opacities, scales = gaussians.opacities, gaussians.scales
        if growable is not None:
            opacities, scales = opacities[growable], scales[growable]
        if not len(opacities):
            return gaussians.opacities.new_zeros(())
        return self.config.opacity_reg * opacities.mean() + self.config.scale_reg * scales.mean()

    @torch.no_grad()
    def perturb(
        self,
        gaussians: Gaussians,
        rate: float,
        generator: torch.Generator,
        growable: Bool[Tensor, "N"] | None = None,
    ) -> None:
        """Moves centres by noise with the shape of the Gaussian; opaque Gaussians hardly move.

        Args:
            gaussians: Edited in place.
            rate: Current learning rate of the centres.
            generator: Random numbers of the noise.
            growable: Mask of the Gaussians that may be moved; None for all.
        """
        means = gaussians.rows["means"]
        noise = upload(torch.randn(means.shape, generator=generator), means.device)
        amount = torch.sigmoid(STEEPNESS * (MOST_NOISE - gaussians.opacities))
        if growable is not None:
            amount = amount * growable
        rotations = quats_to_rotations(gaussians.rows["quats"])
        local = torch.einsum("nji,nj->ni", rotations, noise * (self.config.noise_lr * rate * amount)[:, None])
        means.add_(torch.einsum("nij,nj->ni", rotations, gaussians.scales.square() * local))

    @torch.no_grad()
    def densify(
        self,
        gaussians: Gaussians,
        optimizer: torch.optim.Optimizer,
        generator: torch.Generator,
        *,
        prune_large: bool,
        growable: Bool[Tensor, "N"] | None = None,
        sort: bool = False,
    ) -> DensityReport:
        """Relocates dead Gaussians, and adds up to 5% within the budget; both are copies of Gaussians that stay."""
        count = len(gaussians)
        fixed = torch.zeros_like(gaussians.opacities, dtype=torch.bool) if growable is None else ~growable
        broken = self._broken(gaussians)
        dead = broken | ((gaussians.opacities <= self.config.prune_opacity) & ~fixed)
        weights = torch.where(dead | fixed, 0.0, gaussians.opacities)
        added = max(0, min(self.config.max_gaussians, round(GROWTH * count)) - count)
        drawn = int(dead.sum()) + added
        if not drawn or not bool(weights.any()):
            return DensityReport(0, 0, 0)
        copies = _draw(weights, drawn, generator)
        sources = copies.nonzero()[:, 0]
        keep = ~dead
        keep[sources] = False
        edit_rows(
            gaussians, optimizer, keep, self._shared(gaussians, sources, 1 + copies[sources]), sort=sort
        )
        self._clear(len(gaussians))
        return DensityReport(drawn, 0, int(dead.sum()))

    def _shared(
        self, gaussians: Gaussians, which: Int[Tensor, " S"], number: Int[Tensor, " S"]
    ) -> dict[str, Float[Tensor, "T *rest"]]:
        """Replaces each of the Gaussians by `number` equal ones that together render nearly as it did."""
        rows = self._taken(gaussians, which)
        opacities, factors = shared_opacity(gaussians.opacities[which], number)
        rows["opacity_logits"] = opacities.clamp(self.config.prune_opacity, 1 - 1e-6).logit()
        rows["log_scales"] = rows["log_scales"] + factors.log()[:, None]
        return {name: values.repeat_interleave(number, dim=0) for name, values in rows.items()}


def shared_opacity(
    opacities: Float[Tensor, " S"], number: Int[Tensor, " S"]
) -> tuple[Float[Tensor, " S"], Float[Tensor, " S"]]:
    """Opacity, and factor on the scales, of Gaussians that share the place of one (equation 9 of the paper).

    The inner sum of the paper's equation over rows of Pascal's triangle is replaced by its closed form.

    Args:
        opacities: Opacity of the Gaussian.
        number: How many share its place; at least 1, and counted as at most `MOST_COPIES`.
    """
    limited = number.clamp(max=MOST_COPIES).double()
    old = opacities.double().clamp(1e-6, 1 - 1e-6)  # at 1, the alternating sum loses all digits
    new = 1 - (1 - old) ** (1 / limited)
    power = torch.arange(1, MOST_COPIES + 1, device=opacities.device, dtype=torch.float64)
    n = limited[:, None]
    chosen = torch.lgamma(n + 1) - torch.lgamma(power + 1) - torch.lgamma((n - power).clamp_min(0) + 1)
    terms = torch.where(power <= n, (chosen + power * new[:, None].log()).exp() / power.sqrt(), 0.0)
    sign = torch.where(power % 2 == 1, 1.0, -1.0)
    return new.to(opacities), (old / (sign * terms).sum(dim=1)).to(opacities)


def _draw(weights: Float[Tensor, "N"], count: int, generator: torch.Generator) -> Int[Tensor, "N"]:
    """How often each index is drawn, in `count` draws with replacement."""
    total = weights.double().cumsum(0)
    places = upload(torch.rand(count, generator=generator, dtype=torch.float64), weights.device) * total[-1]
    indices = torch.searchsorted(total, places, right=True).clamp_max(len(weights) - 1)
    return torch.bincount(indices, minlength=len(weights))
