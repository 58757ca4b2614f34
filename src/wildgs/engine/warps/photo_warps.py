"""Warps training photos by fractions of a pixel to where the scene says that they belong.

Not in the paper. Photos of a collection do not coincide to the pixel: real lenses are not as simple as a camera
model, and poses are not exact. Gaussians then learn the mean of photos that are half a pixel apart, which is
blurred. As in texture mapping (Zhou and Koltun, "Color Map Optimization for 3D Reconstruction with Consumer
Depth Cameras", SIGGRAPH 2014), every training photo therefore has a grid of displacements. They begin with what
residuals of structure from motion show (`measured_displacements`). From the second stage on, each time that the
photo is used, they are updated by one step of Lucas and Kanade's image registration (1981) against its render, and
return by a constant to where they began: scene and photos would otherwise drift together, away from the cameras, by
what is found where there is nothing to find. Cameras and held-out photos remain as they are.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from wildgs.devices import upload
from wildgs.engine.config import WarpConfig
from wildgs.engine.team import Team
from wildgs.engine.warps.registration import SIDE, displacement
from wildgs.engine.warps.replays import FunctionReplays
from wildgs.priors.measured_displacements import measured_displacements
from wildgs.priors.resampling import warp
from wildgs.scene import View
from wildgs.scene.residuals import Residuals


class PhotoWarps:
    """Keeps displacements of training photos up to date in training.

    Attributes:
        is_used: Whether photos are warped.
        learns: Whether displacements are updated from the second stage on.
        grids: Displacements of each photo, in order of the views: (x, y) in each cell, in units of the photo's
            longer side. The warped photo at pixel p is the photo at p plus the displacement.
        replays: CUDA graphs of displacing and registering photos.
    """

    grids: Float[Tensor, "V 2 G G"]

    def __init__(
        self,
        views: Sequence[View],
        config: WarpConfig,
        begin: int,
        device: torch.device,
        residuals: Mapping[str, Residuals],
        *,
        used: bool,
    ) -> None:
        """Starts with the displacements that residuals show.

        Args:
            views: Training photos.
            config: Options.
            begin: Number of steps before the first update.
            device: Device of the training.
            residuals: Residuals of structure from motion by the photos' names.
            used: Whether the method's photos are warped.
        """
        self._config, self._begin, self.replays = config, begin, FunctionReplays()
        self._rows = {view.name: row for row, view in enumerate(views)}
        learns = config.rate > 0 and len(views) >= config.photos
        first = torch.zeros(len(views), 2, config.cells, config.cells)
        if used and config.residuals:
            measured = measured_displacements(views, residuals, config.cells, config.least_share)
            used, first = measured.share >= config.least_share, measured.grids
        else:
            used = used and learns
        self.is_used, self.learns = used, used and learns
        self._first = upload(first.clamp(-config.most, config.most), device)
        self.grids = self._first.clone()

    def warped(self, view: View, photo: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W 3"]:
        """The photo at its present displacements."""
        return self.replays(warp, photo, self.grids[self._rows[view.name]]) if self.is_used else photo

    def update(
        self,
        view: View,
        photo: Float[Tensor, "H W 3"],
        render: Float[Tensor, "H W 3"],
        step: int,
        team: Team,
    ) -> None:
        """Improves the displacements of the photos that the ranks use in the step after `step`.

        Args:
            view: This rank's photo.
            photo: The photo as `warped`.
            render: Its render.
            step: Number of steps taken.
            team: The processes that train, whose displacements are kept equal.
        """
        if not self.learns or step < self._begin:
            return
        row = self._rows[view.name]
        improved = self.replays(self._improved, photo, render, self.grids[row], self._first[row])
        for index, found in team.exchange(row, improved):
            self.grids[index] = found

    def _improved(
        self,
        photo: Float[Tensor, "H W 3"],
        render: Float[Tensor, "H W 3"],
        grid: Float[Tensor, "2 G G"],
        first: Float[Tensor, "2 G G"],
    ) -> Float[Tensor, "2 G G"]:
        """Displacements `grid`, which began as `first`, after one step of registration."""
        config, side = self._config, min(SIDE, max(photo.shape[:2]))
        moved = grid - first + config.rate * displacement(photo, render, config.cells)
        moved = functional.softshrink(side * moved, config.friction) / side
        return (first + moved).clamp(-config.most, config.most)

    def tensors(self) -> list[Tensor]:
        """What has to be the same on all ranks, which may compute it with other libraries of linear algebra."""
        return [self.grids, self._first] if self.is_used else []

    def state(self) -> dict[str, Tensor]:
        """What `restore` needs to continue in the same way."""
        return {"grids": self.grids.clone(), "first": self._first.clone()} if self.is_used else {}

    def restore(self, state: dict[str, Tensor]) -> None:
        """Continues from `state`; starts again if the number of photos or cells has changed."""
        grids, first = state.get("grids"), state.get("first")
        if grids is not None and grids.shape == self.grids.shape:
            self.grids = grids.to(self.grids.device).clone()
            if first is not None:
                self._first = first.to(self.grids.device).clone()
