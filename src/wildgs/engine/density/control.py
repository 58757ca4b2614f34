"""What every strategy of density control has: statistics of views, a budget, and edits of the Gaussians."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from wildgs.engine.config import DensityConfig
from wildgs.engine.optimizers import edit_rows, reset_moments
from wildgs.model.gaussians import Gaussians
from wildgs.rasterize import Projection


@dataclass(frozen=True)
class ViewStatistics:
    """What views say about each Gaussian; N rows.

    Attributes:
        demand: How much they ask for more Gaussians in its place, added up over the views; what is measured is the
            strategy's.
        seen: How many views see it.
        largest: The largest of what the strategy measures beside that.
    """

    demand: Float[Tensor, "N"]
    seen: Float[Tensor, "N"]
    largest: Float[Tensor, "N"]


@dataclass(frozen=True)
class DensityReport:
    """What one round did, in numbers of Gaussians."""

    cloned: int
    split: int
    pruned: int


@dataclass(frozen=True)
class SeenView:
    """A training step as density control sees it.

    Attributes:
        projection: Of the Gaussians, after the backward pass.
        colors: The render.
        photo: RGB in [0, 1].
        counts: Which pixels of the photo count: neither transient nor masked by the user; None for all.
    """

    projection: Projection
    colors: Float[Tensor, "H W 3"]
    photo: Float[Tensor, "H W 3"]
    counts: Bool[Tensor, "H W"] | None = None

    @property
    def error(self) -> Float[Tensor, "H W"]:
        """Absolute error of the render, mean over the channels; 0 where the photo does not count."""
        error = (self.colors.detach() - self.photo).abs().mean(dim=-1)
        return error if self.counts is None else torch.where(self.counts, error, 0.0)


class DensityControl(ABC):
    """Gathers statistics of views and edits the Gaussians: `measure` and `densify` are the strategy's."""

    resets: bool = True
    """Whether opacity resets belong to the strategy."""
    until: float = 0.5
    """Share of a run in which it edits."""
    absgrad: bool = False
    """Whether it reads `Projection.absgrad`."""

    def __init__(
        self, config: DensityConfig, extent: float, num_gaussians: int, device: torch.device | str = "cpu"
    ) -> None:
        """Sets up a `DensityControl`.

        Args:
            config: Thresholds.
            extent: Radius of the cameras' region, world units.
            num_gaussians: N now.
            device: Where the Gaussians are.
        """
        self.config = config
        self.extent = extent
        self.device = torch.device(device)
        self._clear(num_gaussians)

    def _clear(self, num_gaussians: int) -> None:
        self.demand = torch.zeros(num_gaussians, device=self.device)
        self.seen = torch.zeros(num_gaussians, device=self.device)
        self.largest = torch.zeros(num_gaussians, device=self.device)

    def state(self) -> dict[str, Tensor]:
        """What `restore` needs; names are those of checkpoints."""
        return {"gradient_sum": self.demand, "seen": self.seen, "reach": self.largest}

    def restore(self, state: dict[str, Tensor]) -> None:
        """Continues where `state` was taken."""
        names = ("gradient_sum", "seen", "reach")
        self.demand, self.seen, self.largest = (state[name].to(self.device) for name in names)

    def measures(self, step: int) -> bool:
        """Whether the strategy reads this step."""
        return True

    @abstractmethod
    def measure(self, view: SeenView, sound: Bool[Tensor, ""] | None = None) -> ViewStatistics:
        """What one view says.

        Args:
            view: After its backward pass.
            sound: False where the step was skipped, so that all is zero; None stands for True.
        """

    @abstractmethod
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
        """One round.

        Args:
            gaussians: Edited in place.
            optimizer: Edited alike.
            generator: Draws positions.
            prune_large: Whether oversized Gaussians go as well.
            growable: Which Gaussians may be cloned, split and pruned; None for all.
            sort: Whether to leave the Gaussians in Morton order.
        """

    @torch.no_grad()
    def gather(
        self,
        view: SeenView,
        pool: Callable[[ViewStatistics], ViewStatistics] | None = None,
        sound: Bool[Tensor, ""] | None = None,
    ) -> None:
        """Adds one view; call after the backward pass.

        Args:
            view: The view.
            pool: Makes one view's statistics those of several processes' views, at once: then what this holds
                is the whole of it in any of them.
            sound: False where the view is not to count, see `measure`.
        """
        statistics = self.measure(view, sound)
        if pool is not None:
            statistics = pool(statistics)
        self.demand = self.demand + statistics.demand
        self.seen = self.seen + statistics.seen
        self.largest = torch.maximum(self.largest, statistics.largest)

    @torch.no_grad()
    def shrink(self, gaussians: Gaussians, optimizer: torch.optim.Optimizer, budget: int) -> int:
        """Drops the least opaque Gaussians beyond a budget; how many it dropped."""
        excess = len(gaussians) - budget
        if excess <= 0:
            return 0
        keep = torch.ones(len(gaussians), dtype=torch.bool, device=gaussians.means.device)
        keep[gaussians.opacities.argsort(stable=True)[:excess]] = False
        edit_rows(gaussians, optimizer, keep, {name: rows[:0] for name, rows in gaussians.rows.items()})
        gathered = {name: value[keep] for name, value in self.state().items()}
        self.restore(gathered)
        return excess

    @torch.no_grad()
    def reset_opacity(
        self,
        gaussians: Gaussians,
        optimizer: torch.optim.Optimizer,
        growable: Bool[Tensor, "N"] | None = None,
    ) -> None:
        """Lowers opacities to `reset_opacity` at most, so that useless Gaussians fade and are pruned.

        Args:
            gaussians: Edited in place.
            optimizer: Whose moments of the opacities are cleared.
            growable: Which Gaussians may be pruned, and so are reset; None for all.
        """
        logits = gaussians.rows["opacity_logits"]
        lowered = logits.clamp(max=float(torch.tensor(self.config.reset_opacity).logit()))
        moments = optimizer.state.get(gaussians.means, {}).get("exp_avg_sq")
        if moments is not None and not self.config.reset_unseen:
            lowered = torch.where((moments == 0).all(dim=1), logits, lowered)
        if growable is not None:
            lowered = torch.where(growable, lowered, logits)
        logits.copy_(lowered)
        reset_moments(optimizer, gaussians, "opacity_logits")

    @staticmethod
    def _broken(gaussians: Gaussians) -> Bool[Tensor, "N"]:
        """Gaussians with a place or size that is not finite."""
        return ~(gaussians.means.isfinite().all(dim=-1) & gaussians.scales.isfinite().all(dim=-1))

    @staticmethod
    def _taken(gaussians: Gaussians, which: Int[Tensor, " C"], times: int = 1) -> dict[str, Tensor]:
        """Rows of some Gaussians, as often as asked for."""
        return {
            name: rows.detach()[which].repeat(times, *[1] * (rows.dim() - 1))
            for name, rows in gaussians.rows.items()
        }
