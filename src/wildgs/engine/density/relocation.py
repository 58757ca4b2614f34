"""Growth and relocation by error: Gaussians move from where they show nothing to where renders are wrong.

3DGS clones and splits by screen gradients, which are small where a render is only blurred, and once a budget is
spent it changes nothing any more. Here some views between two rounds say how much of their error each Gaussian
covers (scores of Taming 3DGS, Mallick et al. 2024, and FastGS, Ren et al. 2025, are of this kind), and how many
pixels it shows. A round splits what covers most error and takes away what shows nothing, so that a full budget goes
on moving, as in 3DGS as Markov chain Monte Carlo (Kheradmand et al. 2024).
"""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from wildgs.engine.density.control import DensityControl, DensityReport, SeenView, ViewStatistics
from wildgs.engine.optimizers import edit_rows
from wildgs.geometry.rotation import quats_to_rotations
from wildgs.model.gaussians import Gaussians
from wildgs.rasterize import Projection, blend

MEASURE_EVERY = 7
"""Steps; each of those costs one more blend of two channels."""
LEAST_VIEWS = 2
"""Before a Gaussian that shows nothing may go."""
MEMORY = 0.8
"""Of what a Gaussian shows at most, from one round to the next."""
HALF_SHIFT, HALF_LENGTH, HALF_WIDTH = 0.6, 0.65, 0.9
"""Of the two halves of a Gaussian, in its own standard deviations: their distance from its centre and their length
along its longest axis, and their width across it. Along the axis they have its spread together."""


class RelocationDensity(DensityControl):
    """Splits what covers most error, and takes away what shows nothing."""

    resets = False
    until = 0.8

    def _clear(self, num_gaussians: int) -> None:
        super()._clear(num_gaussians)
        self.known = torch.zeros(num_gaussians, device=self.device)

    def state(self) -> dict[str, Tensor]:  # noqa: D102 - as in DensityControl
        return super().state() | {"known": self.known + self.seen}

    def restore(self, state: dict[str, Tensor]) -> None:  # noqa: D102 - as in DensityControl
        super().restore(state)
        self.known = state["known"].to(self.device) - self.seen

    def measures(self, step: int) -> bool:
        """Every seventh step."""
        return step % MEASURE_EVERY == 0

    def measure(self, view: SeenView, sound: Bool[Tensor, ""] | None = None) -> ViewStatistics:
        """Error that each Gaussian covers, in pixels times error, and how many pixels it shows."""
        values = view.projection.means2d.new_ones(len(view.projection.means2d), 2, requires_grad=True)
        with torch.enable_grad():
            shown = blend(_detached(view.projection), values, depth=False).colors
        error = view.error
        weights = torch.stack([error, torch.ones_like(error)], dim=-1)
        covered, pixels = torch.autograd.grad(shown, values, weights)[0].unbind(1)
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
        """One round; its size is bounded by the number of Gaussians, the error that is left, and the budget."""
        count = len(gaussians)
        fixed = torch.zeros_like(gaussians.opacities, dtype=torch.bool) if growable is None else ~growable
        most = max(1, round(self.config.grow_share * count))
        gone = self._select_useless(gaussians, fixed, most)
        room = self.config.max_gaussians - count + int(gone.sum())
        split = self._select_wrong(fixed | gone, min(most, room))
        keep = ~gone
        keep[split] = False
        if not (len(split) or int(gone.sum())) or not (len(split) or int(keep.sum())):
            return DensityReport(0, 0, 0)
        source = edit_rows(gaussians, optimizer, keep, self._halves(gaussians, split), sort=sort)
        self._remember(source)
        return DensityReport(0, len(split), int(gone.sum()))

    def _select_useless(self, gaussians: Gaussians, fixed: Tensor, most: int) -> Bool[Tensor, "N"]:
        """Faint ones, broken ones, and of those that show next to nothing the `most` that show least."""
        gone = (gaussians.opacities < self.config.prune_opacity) & ~fixed
        gone = gone | self._broken(gaussians)
        hidden = (
            (self.known + self.seen >= LEAST_VIEWS)
            & (self.largest < self.config.least_pixels)
            & ~fixed
            & ~gone
        )
        least = torch.where(hidden, self.largest, torch.inf).argsort()[: min(most, int(hidden.sum()))]
        gone[least] = True
        return gone

    def _select_wrong(self, excluded: Bool[Tensor, "N"], most: int) -> Int[Tensor, " S"]:
        """Those that cover most error, and enough of it in the views that see them."""
        enough = self.demand > self.config.grow_error * self.seen.clamp_min(1)
        demand = torch.where(enough & ~excluded, self.demand, 0.0)
        chosen = demand.topk(min(max(most, 0), len(demand))).indices
        return chosen[demand[chosen] > 0]

    def _halves(self, gaussians: Gaussians, which: Int[Tensor, " S"]) -> dict[str, Float[Tensor, "T *rest"]]:
        """Two Gaussians in the place of each, side by side along its longest axis."""
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

    def _remember(self, source: Int[Tensor, " M"]) -> None:
        """Carries what Gaussians showed over to their new places; of new ones nothing is known."""
        known, largest = (
            torch.where(source >= 0, value[source.clamp_min(0)], 0.0)
            for value in (self.known + self.seen, MEMORY * self.largest)
        )
        self._clear(len(source))
        self.known, self.largest = known, largest


def _detached(projection: Projection) -> Projection:
    """The same projection, to which no gradient flows."""
    names = ("means2d", "depths", "conics", "opacities")
    return replace(projection, **{name: getattr(projection, name).detach() for name in names}, absgrad=None)
