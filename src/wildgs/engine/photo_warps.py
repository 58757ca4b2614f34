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
from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from wildgs.devices import upload
from wildgs.engine.config import WarpConfig
from wildgs.engine.team import Team
from wildgs.scene import View
from wildgs.scene.images import LUMA

SIDE = 480
"""Longer side, in pixels, to which larger photos are reduced for registration."""
COARSE = 4
"""Cells of this many pixels, whose means are subtracted: light and shadow differ at coarser scales."""
DAMPING = 0.01
"""Added to squared gradients of images of unit contrast, so that nothing is displaced where there is no texture."""
FLAT = 1e-6
"""Added to the variance of a cell: about that of rounding to 8 bits."""
LONGEST = 1.0
"""Largest displacement found at once along an axis, in pixels of the reduced photo; the linear model ends there."""


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


def warp(photo: Float[Tensor, "H W 3"], grid: Float[Tensor, "2 G G"]) -> Float[Tensor, "H W 3"]:
    """Displaces a photo, with bicubic interpolation; its border continues beyond it.

    Args:
        photo: RGB in [0, 1].
        grid: Displacements (x, y) in units of the longer side.
    """
    height, width = photo.shape[:2]
    x, y = 2 * max(height, width) * _interpolated(grid, height, width)
    columns, rows = (
        (torch.arange(count, device=photo.device) * 2 + 1) / count - 1 for count in (width, height)
    )
    places = torch.stack([columns + x / width, rows[:, None] + y / height], dim=-1)
    warped = functional.grid_sample(
        photo.permute(2, 0, 1)[None],
        places[None],
        mode="bicubic",
        padding_mode="border",
        align_corners=False,
    )
    return warped[0].permute(1, 2, 0).contiguous().clamp_(0, 1)


def displacement(
    photo: Float[Tensor, "H W 3"], render: Float[Tensor, "H W 3"], cells: int
) -> Float[Tensor, "2 G G"]:
    """Where the photo shows what the render shows: one step of Lucas and Kanade's registration.

    Minimises, over a window of a few cells, the squared difference between the fine detail of the render and of the
    displaced photo, each divided by its contrast there. Cells count by the squared correlation of the two, so that
    passers-by, who are not in the render, do not move anything.

    Args:
        photo: RGB in [0, 1].
        render: The scene from the photo's camera.
        cells: Number of cells G along each side.

    Returns:
        Displacements (x, y) in units of the longer side.
    """
    seen, shown = _fine_detail(photo, render)
    across = functional.pad(seen[:, 2:] - seen[:, :-2], (1, 1)) / 2
    down = functional.pad(seen[2:] - seen[:-2], (0, 0, 1, 1)) / 2
    pairs = [(seen, seen), (shown, shown), (seen, shown), (across, across), (across, down), (down, down)]
    pairs += [(across, shown), (down, shown), (across, seen), (down, seen)]
    products = seen.new_empty(len(pairs), *seen.shape)
    for product, (first, second) in zip(products, pairs, strict=True):
        torch.mul(first, second, out=product)
    means = _smoothed(_pooled(products, cells, cells))
    variance, both = means[0] + FLAT, ((means[0] + FLAT) * (means[1] + FLAT)).sqrt()
    likeness = (means[2] / both).clamp_min(0).square()
    gradients, errors = means[3:6] / variance, means[6:8] / both - means[8:10] / variance
    xx, xy, yy, x, y = _smoothed(likeness * torch.cat([gradients, errors])).unbind()
    xx, yy = xx + DAMPING, yy + DAMPING
    moves = torch.stack([yy * x - xy * y, xx * y - xy * x]) / (xx * yy - xy * xy)
    # A render that is not finite moves nothing.
    return moves.clamp(-LONGEST, LONGEST).nan_to_num() / max(seen.shape)


def _fine_detail(*images: Float[Tensor, "H W 3"]) -> Float[Tensor, "K h w"]:
    """Brightness of images of at most `SIDE` pixels, without details coarser than `COARSE` pixels."""
    grey = torch.stack([image @ _luma(image.device) for image in images])
    scale = min(1.0, SIDE / max(grey.shape[1:]))
    height, width = (max(3, round(scale * side)) for side in grey.shape[1:])
    if (height, width) != grey.shape[1:]:
        grey = _pooled(grey, height, width)
    coarse = _pooled(grey, -(-height // COARSE), -(-width // COARSE))
    return grey - _interpolated(coarse, height, width)


def _smoothed(maps: Float[Tensor, "K G G"]) -> Float[Tensor, "K G G"]:
    """Binomial mean over three cells along each axis."""
    padded = functional.pad(maps[None], (1, 1, 1, 1), mode="replicate")[0]
    rows = padded[:, :-2] + 2 * padded[:, 1:-1] + padded[:, 2:]
    return (rows[..., :-2] + 2 * rows[..., 1:-1] + rows[..., 2:]) / 16


def _interpolated(maps: Float[Tensor, "K h w"], height: int, width: int) -> Float[Tensor, "K H W"]:
    """Bilinear interpolation; several times as fast as torch's from few cells."""
    rows = _interpolation(maps.shape[1], height, maps.device)
    columns = _interpolation(maps.shape[2], width, maps.device)
    return rows @ maps @ columns.T


def _pooled(maps: Float[Tensor, "K H W"], height: int, width: int) -> Float[Tensor, "K h w"]:
    """Means over cells of equal size."""
    rows = _pooling(maps.shape[1], height, maps.device)
    columns = _pooling(maps.shape[2], width, maps.device)
    return rows @ maps @ columns.T


@lru_cache
def _luma(device: torch.device) -> Float[Tensor, "3"]:
    return upload(torch.tensor(LUMA), device)


@lru_cache(maxsize=64)
def _interpolation(cells: int, pixels: int, device: torch.device) -> Float[Tensor, "pixels cells"]:
    unit = torch.eye(cells, device=device)[None]
    return functional.interpolate(unit, size=pixels, mode="linear")[0].T.contiguous()


@lru_cache(maxsize=64)
def _pooling(pixels: int, cells: int, device: torch.device) -> Float[Tensor, "cells pixels"]:
    """Weights of pixels in the means of cells, those at borders of cells in part in either."""
    ends = torch.arange(cells + 1, device=device) * (pixels / cells)
    start = torch.arange(pixels, device=device)
    first, last = ends[:-1, None], ends[1:, None]
    shared = torch.minimum(last, start + 1) - torch.maximum(first, start)
    return shared.clamp_min(0) * (cells / pixels)
