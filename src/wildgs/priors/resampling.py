"""Displaced photos, and means and interpolation over grids of cells: Numba on the CPU, torch on other devices."""

from __future__ import annotations

from functools import lru_cache

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from wildgs.priors.resampling_kernels import ROWS, warp_rows
from wildgs.threads import launch


def warp(photo: Float[Tensor, "H W 3"], grid: Float[Tensor, "2 G G"]) -> Float[Tensor, "H W 3"]:
    """Displaces a photo, with bicubic interpolation; its border continues beyond it.

    Args:
        photo: RGB in [0, 1].
        grid: Displacements (x, y) in units of the longer side.
    """
    height, width = photo.shape[:2]
    if photo.device.type != "cpu":
        return sampled(photo, max(height, width) * interpolated(grid, height, width))
    rows = interpolation(grid.shape[1], height, grid.device)
    shifts = (max(height, width) * (rows @ grid)).transpose(0, 1).contiguous()
    photo = photo.contiguous()
    warped, (cells, weights) = torch.empty_like(photo), between(grid.shape[2], width)
    arrays = (tensor.numpy() for tensor in (photo, shifts, cells, weights, warped))
    launch(warp_rows, *arrays, items=-(-height // ROWS))
    return warped


def sampled(photo: Float[Tensor, "H W 3"], shifts: Float[Tensor, "2 H W"]) -> Float[Tensor, "H W 3"]:
    """`warp` by torch's operations, with the displacement (x, y) of every pixel, in pixels."""
    height, width = photo.shape[:2]
    columns, rows = (
        (torch.arange(count, device=photo.device) * 2 + 1) / count - 1 for count in (width, height)
    )
    x, y = 2 * shifts
    places = torch.stack([columns + x / width, rows[:, None] + y / height], dim=-1)
    warped = functional.grid_sample(
        photo.permute(2, 0, 1)[None],
        places[None],
        mode="bicubic",
        padding_mode="border",
        align_corners=False,
    )
    return warped[0].permute(1, 2, 0).contiguous().clamp_(0, 1)


def interpolated(maps: Float[Tensor, "K h w"], height: int, width: int) -> Float[Tensor, "K H W"]:
    """Bilinear interpolation; several times as fast as torch's from few cells."""
    rows = interpolation(maps.shape[1], height, maps.device)
    columns = interpolation(maps.shape[2], width, maps.device)
    return rows @ maps @ columns.T


def pooled(maps: Float[Tensor, "K H W"], height: int, width: int) -> Float[Tensor, "K h w"]:
    """Means over cells of equal size."""
    rows = pooling(maps.shape[1], height, maps.device)
    columns = pooling(maps.shape[2], width, maps.device)
    return rows @ maps @ columns.T


@lru_cache(maxsize=64)
def interpolation(cells: int, pixels: int, device: torch.device) -> Float[Tensor, "pixels cells"]:
    """Weights of cells in pixels that are interpolated between their centres."""
    unit = torch.eye(cells, device=device)[None]
    return functional.interpolate(unit, size=pixels, mode="linear")[0].T.contiguous()


@lru_cache(maxsize=64)
def between(cells: int, pixels: int) -> tuple[Int[Tensor, "pixels"], Float[Tensor, "pixels"]]:
    """The lower of the two cells between which each pixel is interpolated, and the weight of the upper one."""
    place = ((torch.arange(pixels) + 0.5) * (cells / pixels) - 0.5).clamp(0, cells - 1)
    lower = place.long().clamp_max(max(cells - 2, 0))
    return lower, place - lower


@lru_cache(maxsize=64)
def pooling(pixels: int, cells: int, device: torch.device) -> Float[Tensor, "cells pixels"]:
    """Weights of pixels in the means of cells, those at borders of cells in part in either."""
    ends = torch.arange(cells + 1, device=device) * (pixels / cells)
    start = torch.arange(pixels, device=device)
    first, last = ends[:-1, None], ends[1:, None]
    shared = torch.minimum(last, start + 1) - torch.maximum(first, start)
    return shared.clamp_min(0) * (cells / pixels)
