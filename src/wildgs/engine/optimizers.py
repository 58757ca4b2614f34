"""Adam for Gaussians and networks; adding, removing and sorting Gaussians together with Adam's moments."""

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
    """Learning rates of the geometry, which every method has.

    Args:
        config: The configured learning rates.
        extent: Scene extent, by which that of positions is scaled.
        steps: Number of training steps.
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
    """Adam for the per-Gaussian parameters (one group per entry of `Gaussians.rows`) and for the networks.

    Attributes:
        config: Learning rates of the geometry.
        row_rates: Learning rate of every per-Gaussian parameter.
        network_rates: Learning rate of every other group, by name.
        rows: Optimiser of `Gaussians.rows`, with eps = 1e-15 as in 3DGS.
        networks: Optimiser of all other parameters; None if a method has none.
        photos: Number of photos over which the gradient of a step is averaged.
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
        """Creates the optimisers of a method.

        Args:
            method: The method.
            config: Learning rates of the geometry.
            extent: Scene extent: radius of the camera positions, in units of the aligned frame.
            photos: Number of photos over which the gradient of a step is averaged.
            steps: Number of training steps.
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

    @property
    def means_rate(self) -> float:
        """Current learning rate of the centres of the Gaussians."""
        return next(group["lr"] for group in self.rows.param_groups if group["name"] == "means")

    def parameters(self) -> list[Tensor]:
        """All trained parameters, found faster than by walking through the method's modules."""
        return [parameter for _, _, parameter, _ in self._parameters()]

    def set_progress(self, progress: float) -> None:
        """Sets all learning rates for a fraction of the run, 0 to 1."""
        for optimizer, rates in ((self.rows, self.row_rates), (self.networks, self.network_rates)):
            for group in [] if optimizer is None else optimizer.param_groups:
                chosen = rates[group["name"]]
                group["lr"] = chosen.start * (self.rate * exponential(1.0, chosen.decay, progress))

    def step(self, faulty: Float[Tensor, ""] | None = None) -> None:
        """Takes one Adam step and clears the gradients.

        Args:
            faulty: Nonzero to skip the step; evaluated on the device, without synchronisation.
        """
        for optimizer in (self.rows, self.networks):
            if optimizer is not None:
                optimizer.found_inf = faulty  # pyright: ignore[reportAttributeAccessIssue]
                optimizer.step()
                optimizer.zero_grad(set_to_none=True)

    def state(self) -> dict[str, Tensor]:
        """Adam's moments and step counts by name.

        Steps are counted in photos, so that training can continue with another number of photos per step.
        """
        return {
            f"{kind}.{index}.{key}": value * self.photos if key == "step" else value
            for kind, index, parameter, optimizer in self._parameters()
            for key, value in optimizer.state.get(parameter, {}).items()
        }

    def restore(self, state: dict[str, Tensor]) -> None:
        """Restores the result of `state` for the same method with the same Gaussians."""
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
    """Copies a moment into its parameter's memory layout, as fused Adam requires."""
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
    """Removes and adds Gaussians, in parameters and optimiser state.

    Args:
        gaussians: Edited in place.
        optimizer: Optimiser with one group per entry of `gaussians.rows`.
        keep: Gaussians to keep.
        added: Parameters of the new Gaussians, and `Gaussians.photos` if there is any; their Adam moments are zero.
        sort: Whether to sort all Gaussians in Morton order (`sort_rows`); else the new ones are appended.

    Returns:
        For each Gaussian its previous index; -1 for new ones.
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
    """Sorts Gaussians in Morton order, in parameters and optimiser state.

    Neighbouring Gaussians then access the same triplane cells, which improves cache use of sampling and scattering.

    Returns:
        For each Gaussian its previous index.
    """
    order = morton_order(gaussians.means)
    _change_rows(gaussians, optimizer, lambda _, values, moments: values[order])
    return order


def _change_rows(
    gaussians: Gaussians, optimizer: torch.optim.Optimizer, change: Callable[[str, Tensor, bool], Tensor]
) -> None:
    """Replaces every parameter and its moments by the result of `change(name, values, moments)`."""
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
    if gaussians.photos is not None:
        gaussians.photos = change("photos", gaussians.photos, False)


@torch.no_grad()
def reset_moments(optimizer: torch.optim.Optimizer, gaussians: Gaussians, name: str) -> None:
    """Clears the Adam moments of one parameter (after its values were overwritten)."""
    state = optimizer.state.get(gaussians.rows[name], {})
    for key in ("exp_avg", "exp_avg_sq"):
        if key in state:
            state[key].zero_()
