"""Base class of the strategies of density control: statistics of views, budget, and edits of the Gaussians."""

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
    """Statistics of each Gaussian over views; N rows.

    Attributes:
        demand: Sum over views of a measure of how much more Gaussians are needed there; defined by the strategy.
        seen: Number of views in which the Gaussian is visible.
        largest: Maximum over views of a second measure, defined by the strategy.
    """

    demand: Float[Tensor, "N"]
    seen: Float[Tensor, "N"]
    largest: Float[Tensor, "N"]


@dataclass(frozen=True)
class DensityReport:
    """Numbers of Gaussians that one round of densification edited."""

    cloned: int
    split: int
    pruned: int


@dataclass(frozen=True)
class SeenView:
    """Data of a training step for density control.

    Attributes:
        projection: Projection of the Gaussians, after the backward pass.
        colors: The blended colours.
        painted: Colours of the Gaussians, of which `colors` is blended.
        photo: RGB in [0, 1].
        counts: Mask of the photo's pixels that are neither transient nor masked by the user; None for all.
        picture: The render that is compared with the photo, if it is not `colors`.
        blended: What `DensityControl.before_backward` computed: for each Gaussian sums over pixels, weighted by its
            share of the pixel; defined by the strategy.
    """

    projection: Projection
    colors: Float[Tensor, "H W 3"]
    painted: Float[Tensor, "N 3"]
    photo: Float[Tensor, "H W 3"]
    counts: Bool[Tensor, "H W"] | None = None
    picture: Float[Tensor, "H W 3"] | None = None
    blended: Float[Tensor, "N S"] | None = None

    @property
    def error(self) -> Float[Tensor, "H W"]:
        """Absolute error of the render, mean over the channels; 0 at masked pixels."""
        picture = self.colors if self.picture is None else self.picture
        error = (picture.detach() - self.photo).abs().mean(dim=-1)
        return error if self.counts is None else torch.where(self.counts, error, 0.0)


class DensityControl(ABC):
    """Gathers statistics of views and edits the Gaussians; strategies implement `measure` and `densify`."""

    resets: bool = True
    """Whether the strategy includes opacity resets."""
    until: float = 0.5
    """Share of the training steps after which densification ends."""
    every: int = 100
    """Steps between densifications in a run of 30,000 steps."""
    absgrad: bool = False
    """Whether the strategy needs `Projection.absgrad`."""
    perturbs: bool = False
    """Whether the strategy regularises the Gaussians and perturbs them after every step."""

    def __init__(
        self, config: DensityConfig, extent: float, num_gaussians: int, device: torch.device | str = "cpu"
    ) -> None:
        """Initialises empty statistics.

        Args:
            config: Thresholds.
            extent: Radius of the cameras' region, world units.
            num_gaussians: Current number of Gaussians N.
            device: Device of the Gaussians.
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
        """Statistics for `restore`; the names are part of the checkpoint format."""
        return {"gradient_sum": self.demand, "seen": self.seen, "reach": self.largest}

    def restore(self, state: dict[str, Tensor]) -> None:
        """Restores statistics from `state`."""
        names = ("gradient_sum", "seen", "reach")
        self.demand, self.seen, self.largest = (state[name].to(self.device) for name in names)

    def measures(self, step: int) -> bool:
        """Whether the strategy gathers statistics in this step."""
        return True

    def before_backward(self, view: SeenView) -> SeenView:
        """Completes a view before the step's backward pass, which frees the graph; by default does nothing."""
        return view

    def regularizer(
        self, gaussians: Gaussians, growable: Bool[Tensor, "N"] | None = None
    ) -> Float[Tensor, ""]:
        """A term of the loss; called if `perturbs`, by default 0."""
        return gaussians.means.new_zeros(())

    def perturb(  # noqa: B027 - optional
        self,
        gaussians: Gaussians,
        rate: float,
        generator: torch.Generator,
        growable: Bool[Tensor, "N"] | None = None,
    ) -> None:
        """Changes the Gaussians after every step; called if `perturbs`, by default does nothing."""

    @abstractmethod
    def measure(self, view: SeenView, sound: Bool[Tensor, ""] | None = None) -> ViewStatistics:
        """Computes the statistics of one view.

        Args:
            view: The view, after its backward pass.
            sound: False if the step was skipped (non-finite values): all statistics are zero then. None means True.
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
        """Runs one round of densification and pruning.

        Args:
            gaussians: Edited in place.
            optimizer: Its state is edited in the same way.
            generator: Random numbers of new positions.
            prune_large: Whether to prune oversized Gaussians too.
            growable: Mask of the Gaussians that may be cloned, split and pruned; None for all.
            sort: Whether to sort the Gaussians in Morton order.
        """

    @torch.no_grad()
    def gather(
        self,
        view: SeenView,
        pool: Callable[[ViewStatistics], ViewStatistics] | None = None,
        sound: Bool[Tensor, ""] | None = None,
    ) -> None:
        """Adds the statistics of one view; call after the backward pass.

        Args:
            view: The view.
            pool: Combines the statistics of the views of several processes (all-reduce), so that all processes hold
                the same totals.
            sound: False if the view must be ignored, see `measure`.
        """
        statistics = self.measure(view, sound)
        if pool is not None:
            statistics = pool(statistics)
        self.demand = self.demand + statistics.demand
        self.seen = self.seen + statistics.seen
        self.largest = torch.maximum(self.largest, statistics.largest)

    @torch.no_grad()
    def shrink(self, gaussians: Gaussians, optimizer: torch.optim.Optimizer, budget: int) -> int:
        """Removes the least opaque Gaussians beyond a budget; returns how many were removed."""
        excess = len(gaussians) - budget
        if excess <= 0:
            return 0
        keep = torch.ones(len(gaussians), dtype=torch.bool, device=gaussians.means.device)
        keep[gaussians.opacities.argsort(stable=True)[:excess]] = False
        edit_rows(gaussians, optimizer, keep, self._taken(gaussians, keep.new_zeros(0, dtype=torch.int64)))
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
        """Clamps opacities to at most `reset_opacity`, so that useless Gaussians do not recover and are pruned.

        Args:
            gaussians: Edited in place.
            optimizer: Its moments of the opacities are cleared.
            growable: Mask of the Gaussians that may be pruned and are therefore reset; None for all.
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
        """Mask of Gaussians with a non-finite position or scale."""
        return ~(gaussians.means.isfinite().all(dim=-1) & gaussians.scales.isfinite().all(dim=-1))

    @staticmethod
    def _taken(gaussians: Gaussians, which: Int[Tensor, " C"], times: int = 1) -> dict[str, Tensor]:
        """Copies the parameters of selected Gaussians, and the photos that show them, `times` times."""
        values = dict(gaussians.rows.items())
        if gaussians.photos is not None:
            values["photos"] = gaussians.photos
        return {
            name: rows.detach()[which].repeat(times, *[1] * (rows.dim() - 1)) for name, rows in values.items()
        }
