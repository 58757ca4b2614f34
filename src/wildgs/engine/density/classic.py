"""Density control of 3D Gaussian Splatting (Kerbl et al. 2023, section 5): clone, split, prune, reset."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from wildgs.devices import upload
from wildgs.engine.density.control import DensityControl, DensityReport, SeenView, ViewStatistics
from wildgs.engine.optimizers import edit_rows
from wildgs.geometry.camera import quats_to_rotations
from wildgs.model.gaussians import Gaussians

SPLIT_INTO = 2
SPLIT_SHRINK = 1.6


class ClassicDensity(DensityControl):
    """Clones small and splits large Gaussians where the mean screen gradient of their centres is large."""

    grow_factor: float = 1.0
    """Factor on `DensityConfig.grow_gradient`."""

    @torch.no_grad()
    def measure(self, view: SeenView, sound: Bool[Tensor, ""] | None = None) -> ViewStatistics:
        """Screen gradients in units of half the image size, and radii relative to the longer side of the image."""
        projection = view.projection
        gradient = projection.absgrad if self.absgrad else projection.means2d.grad
        if gradient is None:
            zeros = torch.zeros_like(projection.means2d[:, 0])
            return ViewStatistics(zeros, zeros, zeros)
        camera = projection.camera
        x, y = gradient.unbind(1)
        norm = torch.hypot(x * (camera.width / 2), y * (camera.height / 2))
        visible = projection.visible if sound is None else projection.visible & sound
        return ViewStatistics(
            demand=torch.where(visible, norm, 0.0),
            seen=visible.to(norm),
            largest=torch.where(visible, projection.radii / max(camera.width, camera.height), 0.0),
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
        """Clones and splits Gaussians with large screen gradients; prunes Gaussians of low opacity."""
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
        prune = prune | self._broken(gaussians)
        clones, splits = clones & ~prune, splits & ~prune
        keep = ~(splits | prune)
        cloned, split, pruned, kept = torch.stack([m.sum() for m in (clones, splits, prune, keep)]).tolist()
        if not kept and not split:
            return DensityReport(0, 0, 0)
        if cloned or split or pruned:
            added = self._taken(gaussians, clones.nonzero()[:, 0])
            halves = self._split(gaussians, splits.nonzero()[:, 0], generator)
            added = {name: torch.cat([rows, halves[name]]) for name, rows in added.items()}
            edit_rows(gaussians, optimizer, keep, added, sort=sort)
        self._clear(len(gaussians))
        return DensityReport(cloned, split, pruned)

    def _select_large(self, gaussians: Gaussians, largest: Float[Tensor, "N"]) -> Bool[Tensor, "N"]:
        """Mask of Gaussians that are too large in the world or in an image."""
        allowed = torch.full_like(largest, self.extent)
        if self.config.prune_by_distance:
            distance = (gaussians.means - gaussians.means.nanmedian(dim=0).values).norm(dim=-1)
            allowed = distance.clamp_min(self.extent)
        large = largest > self.config.prune_scale * allowed
        if self.config.prune_reach > 0:
            large = large | (self.largest > self.config.prune_reach)
        return large

    def _select_growing(self, growable: Bool[Tensor, "N"] | None) -> Bool[Tensor, "N"]:
        mean = self.demand / self.seen.clamp_min(1)
        if growable is not None:
            mean = mean * growable
        grows = mean > self.grow_factor * self.config.grow_gradient
        room = self.config.max_gaussians - len(mean)
        if int(grows.sum()) > room:
            grows = torch.zeros_like(grows)
            if room > 0:
                grows[mean.topk(room).indices] = True
        return grows

    def _split(
        self, gaussians: Gaussians, which: Int[Tensor, " C"], generator: torch.Generator
    ) -> dict[str, Tensor]:
        """Two smaller Gaussians for each one, with means sampled from its distribution."""
        rows = self._taken(gaussians, which, SPLIT_INTO)
        noise = upload(torch.randn(len(rows["means"]), 3, generator=generator), rows["means"].device)
        offsets = noise * rows["log_scales"].exp()
        rows["means"] = rows["means"] + torch.einsum("nij,nj->ni", quats_to_rotations(rows["quats"]), offsets)
        rows["log_scales"] = rows["log_scales"] - torch.tensor(SPLIT_SHRINK).log()
        return rows


class AbsGradDensity(ClassicDensity):
    """Uses absolute screen gradients (AbsGS, Ye et al. 2024), which do not cancel over the pixels of a Gaussian.

    The threshold is four times that of 3DGS, as gsplat recommends for absolute gradients.
    """

    absgrad = True
    grow_factor = 4.0
