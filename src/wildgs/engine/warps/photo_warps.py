"""Warps training photos by fractions of a pixel to where the scene says that they belong.

Not in the paper. Photos of a collection do not coincide to the pixel: real lenses are not as simple as a camera
model, and poses are not exact. Gaussians then learn the mean of photos that are half a pixel apart, which is
blurred. As in texture mapping (Zhou and Koltun, "Color Map Optimization for 3D Reconstruction with Consumer
Depth Cameras", SIGGRAPH 2014), every training photo therefore has a grid of displacements. Each time that the
photo is used, they are updated by one step of Lucas and Kanade's image registration (1981) against its render.
Each time, they also decrease by a constant: scene and photos would otherwise drift together, away from the
cameras, by what is found where there is nothing to find. Cameras and held-out photos remain as they are.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from wildgs.engine.config import WarpConfig
from wildgs.engine.team import Team
from wildgs.engine.warps.registration import SIDE, displacement
from wildgs.engine.warps.resampling import warp
from wildgs.scene import View


class PhotoWarps:
    """Keeps displacements of training photos up to date in training.

    Attributes:
        grids: Displacements of each photo, in order of the views: (x, y) in each cell, in units of the photo's
            longer side. The warped photo at pixel p is the photo at p plus the displacement.
    """

    grids: Float[Tensor, "V 2 G G"]

    def __init__(
        self, views: Sequence[View], config: WarpConfig, begin: int, device: torch.device, *, used: bool
    ) -> None:
        """Starts without displacements.

        Args:
            views: Training photos.
            config: Options.
            begin: Number of steps before the first photo is warped.
            device: Device of the training.
            used: Whether the method's photos are warped.
        """
        self._config, self._begin = config, begin
        self._rows = {view.name: row for row, view in enumerate(views)}
        self.is_used = used and config.rate > 0 and len(views) >= config.photos
        self.grids = torch.zeros(len(views), 2, config.cells, config.cells, device=device)

    def has_begun(self, step: int) -> bool:
        """Whether the photo of the step after `step` is warped."""
        return self.is_used and step >= self._begin

    def warped(self, view: View, photo: Float[Tensor, "H W 3"], step: int) -> Float[Tensor, "H W 3"]:
        """The photo for the step after `step`."""
        return warp(photo, self.grids[self._rows[view.name]]) if self.has_begun(step) else photo

    @torch.no_grad()
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
        if not self.has_begun(step):
            return
        row, config = self._rows[view.name], self._config
        move = displacement(photo, render, config.cells)
        side = min(SIDE, max(photo.shape[:2]))
        grid = side * (self.grids[row] + config.rate * move)
        grid = (functional.softshrink(grid, config.friction) / side).clamp(-config.most, config.most)
        for index, found in team.exchange(row, grid):
            self.grids[index] = found

    def state(self) -> dict[str, Tensor]:
        """What `restore` needs to continue in the same way."""
        return {"grids": self.grids.clone()} if self.is_used else {}

    def restore(self, state: dict[str, Tensor]) -> None:
        """Continues from `state`; starts again if the number of photos or cells has changed."""
        grids = state.get("grids")
        if grids is not None and grids.shape == self.grids.shape:
            self.grids = grids.to(self.grids.device).clone()
