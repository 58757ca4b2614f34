"""Adaptive density control as in 3D Gaussian Splatting (Kerbl et al. 2023, section 5)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from wildgs.engine.config import DensityConfig
from wildgs.engine.optimizers import edit_rows, reset_moments
from wildgs.geometry.rotation import quats_to_rotations
from wildgs.model.gaussians import Gaussians
from wildgs.rasterize import Projection
from wildgs.scene.scene import upload

SPLIT_INTO = 2
SPLIT_SHRINK = 1.6


@dataclass(frozen=True)
class ScreenStatistics:
    """What views say about each Gaussian; N rows.

    Attributes:
        gradient_sum: Norms of the screen gradient, per half picture, added up over the views that see it.
        seen: How many views do.
        reach: Its largest radius, as a share of a picture's longer side.
    """

    gradient_sum: Float[Tensor, "N"]
    seen: Float[Tensor, "N"]
    reach: Float[Tensor, "N"]


@dataclass(frozen=True)
class DensityReport:
    """What one round did, in numbers of Gaussians."""

    cloned: int
    split: int
    pruned: int


class DensityControl:
    """Gathers screen statistics and edits the Gaussians."""

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
        self.gradient_sum = torch.zeros(num_gaussians, device=self.device)
        self.seen = torch.zeros(num_gaussians, device=self.device)
        self.reach = torch.zeros(num_gaussians, device=self.device)

    def state(self) -> dict[str, Tensor]:
        """What `restore` needs."""
        return {"gradient_sum": self.gradient_sum, "seen": self.seen, "reach": self.reach}

    def restore(self, state: dict[str, Tensor]) -> None:
        """Continues where `state` was taken."""
        names = ("gradient_sum", "seen", "reach")
        self.gradient_sum, self.seen, self.reach = (state[name].to(self.device) for name in names)

    @torch.no_grad()
    def gather(
        self,
        projection: Projection,
        pool: Callable[[ScreenStatistics], ScreenStatistics] | None = None,
        sound: Bool[Tensor, ""] | None = None,
    ) -> None:
        """Adds one view's screen gradients and reaches; call after the backward pass.

        Args:
            projection: Of that view.
            pool: Makes one view's statistics those of several processes' views, at once: then what this holds
                is the whole of it in any of them.
            sound: False where the view is not to count, see `measure`.
        """
        statistics = self.measure(projection, sound)
        if pool is not None:
            statistics = pool(statistics)
        self.gradient_sum = self.gradient_sum + statistics.gradient_sum
        self.seen = self.seen + statistics.seen
        self.reach = torch.maximum(self.reach, statistics.reach)

    @staticmethod
    @torch.no_grad()
    def measure(projection: Projection, sound: Bool[Tensor, ""] | None = None) -> ScreenStatistics:
        """One view's screen gradients and reaches; zeros where no gradient reached the screen.

        Args:
            projection: Of the view.
            sound: False where the step was skipped, so that all is zero; None stands for True.
        """
        gradient = projection.means2d.grad
        if gradient is None:
            zeros = torch.zeros_like(projection.means2d[:, 0])
            return ScreenStatistics(zeros, zeros, zeros)
        camera = projection.camera
        x, y = gradient.unbind(1)
        norm = torch.hypot(x * (camera.width / 2), y * (camera.height / 2))
        visible = projection.visible if sound is None else projection.visible & sound
        return ScreenStatistics(
            gradient_sum=torch.where(visible, norm, 0.0),
            seen=visible.to(norm),
            reach=torch.where(visible, projection.radii / max(camera.width, camera.height), 0.0),
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
        """One round: clones and splits where the screen gradient is large, prunes the faint.

        Args:
            gaussians: Edited in place.
            optimizer: Edited alike.
            generator: Draws the split positions.
            prune_large: Whether oversized Gaussians go as well.
            growable: Which Gaussians may be cloned, split and pruned; None for all.
            sort: Whether to leave the Gaussians in Morton order.
        """
        scales = gaussians.scales
        largest = scales.max(dim=-1).values
        grows = self._select_growing(growable)
        clones = grows & (largest <= self.config.split_scale * self.extent)
        splits = grows & ~clones
        prune = gaussians.opacities < self.config.prune_opacity
        if prune_large:
            prune = prune | self._select_large(gaussians, largest)
        if growable is not None:
            prune = prune & growable
        finite = torch.isfinite(gaussians.means).all(dim=-1) & torch.isfinite(largest)
        prune = prune | ~finite
        clones, splits = clones & ~prune, splits & ~prune
        keep = ~(splits | prune)
        cloned, split, pruned, kept = torch.stack([m.sum() for m in (clones, splits, prune, keep)]).tolist()
        if not kept and not split:
            return DensityReport(0, 0, 0)
        if cloned or split or pruned:
            added = self._cloned(gaussians, clones.nonzero()[:, 0])
            halves = self._split(gaussians, splits.nonzero()[:, 0], generator)
            added = {name: torch.cat([rows, halves[name]]) for name, rows in added.items()}
            edit_rows(gaussians, optimizer, keep, added, sort=sort)
        self._clear(len(gaussians))
        return DensityReport(cloned, split, pruned)

    def _select_large(self, gaussians: Gaussians, largest: Float[Tensor, "N"]) -> Bool[Tensor, "N"]:
        """Gaussians that are too large in the scene or on some photo."""
        allowed = torch.full_like(largest, self.extent)
        if self.config.prune_by_distance:
            distance = (gaussians.means - gaussians.means.nanmedian(dim=0).values).norm(dim=-1)
            allowed = distance.clamp_min(self.extent)
        large = largest > self.config.prune_scale * allowed
        if self.config.prune_reach > 0:
            large = large | (self.reach > self.config.prune_reach)
        return large

    def _select_growing(self, growable: Bool[Tensor, "N"] | None) -> Bool[Tensor, "N"]:
        mean = self.gradient_sum / self.seen.clamp_min(1)
        if growable is not None:
            mean = mean * growable
        grows = mean > self.config.grow_gradient
        room = self.config.max_gaussians - len(mean)
        if int(grows.sum()) > room:
            grows = torch.zeros_like(grows)
            if room > 0:
                grows[mean.topk(room).indices] = True
        return grows

    @staticmethod
    def _cloned(gaussians: Gaussians, which: Int[Tensor, " C"]) -> dict[str, Tensor]:
        return {name: rows.detach()[which] for name, rows in gaussians.rows.items()}

    @staticmethod
    def _split(
        gaussians: Gaussians, which: Int[Tensor, " C"], generator: torch.Generator
    ) -> dict[str, Tensor]:
        """Two smaller Gaussians drawn from each large one's own distribution."""
        rows = {
            name: values.detach()[which].repeat(SPLIT_INTO, *[1] * (values.dim() - 1))
            for name, values in gaussians.rows.items()
        }
        noise = upload(torch.randn(len(rows["means"]), 3, generator=generator), rows["means"].device)
        offsets = noise * rows["log_scales"].exp()
        rows["means"] = rows["means"] + torch.einsum("nij,nj->ni", quats_to_rotations(rows["quats"]), offsets)
        rows["log_scales"] = rows["log_scales"] - torch.tensor(SPLIT_SHRINK).log()
        return rows

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
