"""Error-based densification and relocation: splits Gaussians with high error, prunes those that contribute nothing.

3DGS clones and splits by screen gradients, which are small where a render is merely blurred; and when its budget is
exhausted, it changes nothing any more. This strategy measures in some of the training views how much of the image
error falls on each Gaussian (similar to the scores of Taming 3DGS, Mallick et al. 2024, and FastGS, Ren et al.
2025), and to how many pixels it contributes. Each round splits the Gaussians with the most error and removes those
without contribution, so that Gaussians are relocated even when the budget is exhausted, as in 3DGS-MCMC (Kheradmand
et al. 2024).
"""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from wildgs.engine.density.control import DensityControl, DensityReport, SeenView, ViewStatistics
from wildgs.engine.optimizers import edit_rows
from wildgs.geometry.camera import quats_to_rotations
from wildgs.model.gaussians import Gaussians

MEASURE_EVERY = 7
"""Interval of measured steps; a measurement costs a further backward pass of the blend."""
LEAST_VIEWS = 2
"""Minimum number of measured views before a Gaussian without contribution is pruned."""
MEMORY = 0.8
"""Decay per round of the maximum contribution of a Gaussian."""
HALF_SHIFT, HALF_LENGTH, HALF_WIDTH = 0.6, 0.65, 0.9
"""The two halves of a split Gaussian, relative to its scales: distance from its centre along the longest axis,
scale along that axis, and scale across it. Together they have about the variance of the original along the axis."""


class RelocationDensity(DensityControl):
    """Splits the Gaussians with the most error, and prunes those that contribute nothing."""

    resets = False
    until = 0.8
    # Gaussians that were split have to be trained again, at first with too large steps: two dozen rounds are enough
    # for runs of any length, and with hundreds many Gaussians never settle.
    every = 1000

    def _clear(self, num_gaussians: int) -> None:
        super()._clear(num_gaussians)
        self.known = torch.zeros(num_gaussians, device=self.device)

    def state(self) -> dict[str, Tensor]:  # noqa: D102 - as in DensityControl
        return super().state() | {"known": self.known + self.seen}

    def restore(self, state: dict[str, Tensor]) -> None:  # noqa: D102 - as in DensityControl
        super().restore(state)
        self.known = state["known"].to(self.device) - self.seen

    def measures(self, step: int) -> bool:
        """Whether this is one of every `MEASURE_EVERY` steps."""
        return step % MEASURE_EVERY == 0

    def before_backward(self, view: SeenView) -> SeenView:
        """Adds blending-weighted sums over pixels of the image error, and of 1."""
        error = view.error
        # A pixel's gradient to a Gaussian's colour is the Gaussian's blending weight, whatever the colours are.
        weights = torch.stack([error, torch.ones_like(error), torch.zeros_like(error)], dim=-1)
        (sums,) = torch.autograd.grad(view.colors, view.painted, weights, retain_graph=True)
        return replace(view, blended=sums)

    def measure(self, view: SeenView, sound: Bool[Tensor, ""] | None = None) -> ViewStatistics:
        """The sums of `before_backward` for visible Gaussians: of the image error, and of 1."""
        assert view.blended is not None
        covered, pixels, _ = view.blended.unbind(1)
        visible = view.projection.visible if sound is None else view.projection.visible & sound
        return ViewStatistics(
            demand=torch.where(visible, covered, 0.0),
            seen=visible.to(covered),
            largest=torch.where(visible, pixels, 0.0),
        )

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
        """Splits and prunes, limited by `grow_share`, `prune_share`, the error threshold, and the budget."""
        count = len(gaussians)
        fixed = torch.zeros_like(gaussians.opacities, dtype=torch.bool) if growable is None else ~growable
        prune = self._select_useless(gaussians, fixed, max(1, round(self.config.prune_share * count)))
        pruned = int(prune.sum())
        room = self.config.max_gaussians - count + pruned
        most = max(1, round(self.config.grow_share * count))
        split = self._select_high_error(fixed | prune, min(most, room))
        keep = ~prune
        keep[split] = False
        if not (len(split) or pruned) or not (len(split) or int(keep.sum())):
            return DensityReport(0, 0, 0)
        source = edit_rows(gaussians, optimizer, keep, self._halves(gaussians, split), sort=sort)
        self._carry_over(source)
        return DensityReport(0, len(split), pruned)

    def _select_useless(self, gaussians: Gaussians, fixed: Tensor, most: int) -> Bool[Tensor, "N"]:
        """Transparent and non-finite Gaussians, and at most `most` of those with the least contribution."""
        prune = (gaussians.opacities < self.config.prune_opacity) & ~fixed
        prune = prune | self._broken(gaussians)
        hidden = (
            (self.known + self.seen >= LEAST_VIEWS)
            & (self.largest < self.config.least_pixels)
            & ~fixed
            & ~prune
        )
        least = torch.where(hidden, self.largest, torch.inf).argsort()[: min(most, int(hidden.sum()))]
        prune[least] = True
        return prune

    def _select_high_error(self, excluded: Bool[Tensor, "N"], most: int) -> Int[Tensor, " S"]:
        """Gaussians with the largest total error, if their mean error per view exceeds `grow_error`."""
        enough = self.demand > self.config.grow_error * self.seen.clamp_min(1)
        demand = torch.where(enough & ~excluded, self.demand, 0.0)
        chosen = demand.topk(min(max(most, 0), len(demand))).indices
        return chosen[demand[chosen] > 0]

    def _halves(self, gaussians: Gaussians, which: Int[Tensor, " S"]) -> dict[str, Float[Tensor, "T *rest"]]:
        """Two Gaussians that replace each one, side by side along its longest axis."""
        rows = self._taken(gaussians, which, 2)
        length, axis = rows["log_scales"].exp().max(dim=1)
        every = torch.arange(len(axis), device=axis.device)
        direction = quats_to_rotations(rows["quats"])[every, :, axis]
        side = torch.where(every < len(which), HALF_SHIFT, -HALF_SHIFT)
        rows["means"] = rows["means"] + (side * length)[:, None] * direction
        factors = torch.full_like(rows["log_scales"], HALF_WIDTH)
        factors[every, axis] = HALF_LENGTH
        rows["log_scales"] = rows["log_scales"] + factors.log()
        return rows

    def _carry_over(self, source: Int[Tensor, " M"]) -> None:
        """Carries statistics over to the edited rows; new Gaussians start without any."""
        known, largest = (
            torch.where(source >= 0, value[source.clamp_min(0)], 0.0)
            for value in (self.known + self.seen, MEMORY * self.largest)
        )
        self._clear(len(source))
        self.known, self.largest = known, largest
