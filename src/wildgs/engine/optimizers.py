"""Adam for Gaussians and networks, and row edits that keep its state aligned with the Gaussians."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from wildgs import features
from wildgs.engine.config import OptimizerConfig
from wildgs.engine.schedule import REFERENCE_STEPS, exponential
from wildgs.geometry.morton import morton_order
from wildgs.model.config import LearningRate
from wildgs.model.gaussians import Gaussians
from wildgs.model.method import Method


def geometry_rates(config: OptimizerConfig, extent: float, steps: int) -> dict[str, LearningRate]:
    """Learning rates of the rows that every method has.

    Args:
        config: The rates.
        extent: Scales positions.
        steps: Length of the run.
    """
    factor = max(1.0, REFERENCE_STEPS / steps) ** config.short_runs
    return {
        "means": LearningRate(factor * config.means * extent, config.means_final / config.means),
        "quats": LearningRate(factor * config.quats),
        "log_scales": LearningRate(factor * config.scales),
        "opacity_logits": LearningRate(config.opacities),
    }


@dataclass
class Optimizers:
    """Adam over the per-Gaussian rows (one group a row) and over the networks.

    Attributes:
        config: Of the geometry.
        row_rates: Learning rate of every row.
        network_rates: Learning rate of every other group, by its name.
        rows: For `Gaussians.rows`; eps 1e-15 as 3DGS.
        networks: For everything else, or None where a method has nothing else.
        photos: Photos in the mean gradient of one step.
    """

    config: OptimizerConfig
    row_rates: dict[str, LearningRate]
    network_rates: dict[str, LearningRate]
    rows: torch.optim.Adam
    networks: torch.optim.Adam | None = field(default=None)
    photos: int = 1

    @classmethod
    def build(
        cls,
        method: Method,
        config: OptimizerConfig,
        extent: float,
        photos: int = 1,
        steps: int = REFERENCE_STEPS,
    ) -> Optimizers:
        """Optimisers for a method.

        Args:
            method: The method.
            config: Learning rates of the geometry.
            extent: Radius of the cameras' region, world units (3DGS's spatial learning rate scale).
            photos: Photos in the mean gradient of one step.
            steps: Length of the run.
        """
        scaled = photos if config.batch_scaling == "sqrt" else 1
        rate, betas = scaled**0.5, (0.9**scaled, 0.999**scaled)
        row_rates = geometry_rates(config, extent, steps) | method.row_rates()
        groups = [
            {"params": [parameter], "name": name, "lr": rate * row_rates[name].start}
            for name, parameter in method.gaussians.rows.items()
        ]
        rows = torch.optim.Adam(groups, betas=betas, eps=1e-15 / rate, fused=True)
        declared = [group for group in method.parameter_groups() if group.parameters]
        network_groups = [
            {"params": group.parameters, "name": group.name, "lr": rate * group.rate.start}
            for group in declared
        ]
        networks = None
        if network_groups:
            networks = torch.optim.Adam(network_groups, betas=betas, eps=1e-8 / rate, fused=True)
        network_rates = {group.name: group.rate for group in declared}
        return cls(config, row_rates, network_rates, rows, networks, photos)

    @property
    def rate(self) -> float:
        """Factor on every learning rate."""
        return self.photos**0.5 if self.config.batch_scaling == "sqrt" else 1.0

    def set_progress(self, progress: float) -> None:
        """Sets every learning rate for a share of the run in [0, 1]."""
        for optimizer, rates in ((self.rows, self.row_rates), (self.networks, self.network_rates)):
            for group in [] if optimizer is None else optimizer.param_groups:
                chosen = rates[group["name"]]
                group["lr"] = chosen.start * (self.rate * exponential(1.0, chosen.decay, progress))

    def step(self, faulty: Float[Tensor, ""] | None = None) -> None:
        """One Adam step everywhere, then clears the gradients.

        Args:
            faulty: Not 0 where the step is not to be taken; read on its device, so that the host need not wait.
        """
        for optimizer in (self.rows, self.networks):
            if optimizer is not None:
                optimizer.found_inf = faulty  # pyright: ignore[reportAttributeAccessIssue]
                optimizer.step()
                optimizer.zero_grad(set_to_none=True)

    def state(self) -> dict[str, Tensor]:
        """Adam's moments and step counts, as flat tensors.

        Steps are counted in photos, so that training may continue with another number of photos a step.
        """
        return {
            f"{kind}.{index}.{key}": value * self.photos if key == "step" else value
            for kind, index, parameter, optimizer in self._parameters()
            for key, value in optimizer.state.get(parameter, {}).items()
        }

    def restore(self, state: dict[str, Tensor]) -> None:
        """Puts back what `state` gave, for the same method with the same rows."""
        for kind, index, parameter, optimizer in self._parameters():
            prefix = f"{kind}.{index}."
            found = {n.removeprefix(prefix): v for n, v in state.items() if n.startswith(prefix)}
            if found:
                optimizer.state[parameter] = {
                    key: _laid_out_as(parameter, value / self.photos if key == "step" else value)
                    for key, value in found.items()
                }

    def _parameters(self) -> Iterator[tuple[str, int, Tensor, torch.optim.Adam]]:
        for kind, optimizer in (("rows", self.rows), ("networks", self.networks)):
            if optimizer is not None:
                parameters = [p for group in optimizer.param_groups for p in group["params"]]
                for index, parameter in enumerate(parameters):
                    yield kind, index, parameter, optimizer


def _laid_out_as(parameter: Tensor, value: Tensor) -> Tensor:
    """A moment in its parameter's memory layout: fused Adam walks both as they lie."""
    if value.shape != parameter.shape:
        return value.to(parameter.device)
    return torch.empty_like(parameter, requires_grad=False).copy_(value)


@torch.no_grad()
def edit_rows(
    gaussians: Gaussians,
    optimizer: torch.optim.Optimizer,
    keep: Bool[Tensor, "N"],
    added: dict[str, Tensor],
    *,
    sort: bool = False,
) -> Int[Tensor, " M"]:
    """Drops and adds Gaussians, in parameters and optimiser state alike.

    Args:
        gaussians: Edited in place.
        optimizer: Holds one group a row, named after it.
        keep: Which present Gaussians stay, in their order.
        added: New Gaussians' rows, one tensor for every row name; they start with empty Adam moments.
        sort: Whether to put all of them in Morton order, see `sort_rows`; else the new ones come last.

    Returns:
        Which of the former Gaussians each is; -1 for new ones.
    """
    kept = keep.nonzero()[:, 0]
    count, new = len(kept), len(added["means"])
    source = torch.cat([kept, kept.new_zeros(new)])
    places = torch.arange(count, count + new, device=keep.device)
    drawn = None
    once = sort and features.is_on("densify_once")
    if once:
        order = morton_order(torch.cat([gaussians.means[kept], added["means"]]))
        source = source[order]
        places = (order >= count).nonzero()[:, 0]
        drawn = order[places] - count

    def edited(name: str, values: Tensor, moments: bool) -> Tensor:
        rows = values.index_select(0, source)
        if moments:
            return rows.index_fill_(0, places, 0.0)
        return rows.index_copy_(
            0, places, added[name].to(values) if drawn is None else added[name].to(values)[drawn]
        )

    _change_rows(gaussians, optimizer, edited)
    origin = source.index_fill(0, places, -1)
    return origin[sort_rows(gaussians, optimizer)] if sort and not once else origin


@torch.no_grad()
def sort_rows(gaussians: Gaussians, optimizer: torch.optim.Optimizer) -> Int[Tensor, " N"]:
    """Puts Gaussians that are near in space near in memory, in parameters and optimiser state alike.

    What samples the triplane and scatters back to it then finds its neighbours' cells in the cache.

    Returns:
        Which of the former Gaussians each is.
    """
    order = morton_order(gaussians.means)
    _change_rows(gaussians, optimizer, lambda _, values, moments: values[order])
    return order


def _change_rows(
    gaussians: Gaussians, optimizer: torch.optim.Optimizer, change: Callable[[str, Tensor, bool], Tensor]
) -> None:
    """Replaces every row's parameter and its moments by what `change(name, values, moments)` makes of them."""
    for group in optimizer.param_groups:
        name = group["name"]
        old = gaussians.rows[name]
        new = nn.Parameter(change(name, old, False))
        state = optimizer.state.pop(old, {})
        for key, value in state.items():
            if isinstance(value, Tensor) and value.shape == old.shape:
                state[key] = change(name, value, True)
        if state:
            optimizer.state[new] = state
        group["params"] = [new]
        gaussians.rows[name] = new


@torch.no_grad()
def reset_moments(optimizer: torch.optim.Optimizer, gaussians: Gaussians, name: str) -> None:
    """Clears the Adam moments of one row (after its values were overwritten)."""
    state = optimizer.state.get(gaussians.rows[name], {})
    for key in ("exp_avg", "exp_avg_sq"):
        if key in state:
            state[key].zero_()
