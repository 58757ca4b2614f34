"""Blending on the CPU: the autograd function around its kernels."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from wildgs.rasterize.cpu import backward_kernels, forward_kernels, tile_kernels
from wildgs.rasterize.cpu.projection import TileLists, scratch
from wildgs.rasterize.cpu.reach_kernels import TILE
from wildgs.rasterize.cpu.simd import LANES
from wildgs.rasterize.interface import Projection, Rendering
from wildgs.threads import flat, launch

_CHUNK = 1024  # Gaussians per work item of a thread


class _Blend(torch.autograd.Function):
    """Autograd function of blending."""

    @staticmethod
    def forward(
        ctx: Any,
        means2d: Tensor,
        conics: Tensor,
        depths: Tensor,
        opacities: Tensor,
        colors: Tensor,
        background: Tensor,
        projection: Projection,
        with_depth: bool,
    ) -> Any:
        tiles: TileLists = projection.tiles
        pictures = _blend_pictures(projection, colors, background, with_depth, bookkeeping=True)
        out_colors, out_depth, out_alpha, ctx.values, ctx.masks, ctx.transmittance, ctx.last = pictures
        ctx.save_for_backward(opacities, colors, background, out_depth, out_alpha)
        ctx.tiles, ctx.camera, ctx.absgrad = (tiles, projection.camera, projection.absgrad)
        ctx.with_depth = with_depth
        return out_colors, out_depth, out_alpha

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> Any:
        v_colors, v_depth, v_alpha = grads
        opacities, colors, background, out_depth, out_alpha = ctx.saved_tensors
        tiles: TileLists = ctx.tiles
        n, channels = colors.shape
        # Whole vectors: one for all sums, and further ones for colours that are not three.
        stride = backward_kernels.ROW_COLORS + (0 if channels == 3 else -(-channels // LANES) * LANES)
        v_means2d, v_conics = torch.empty(n, 2), torch.empty(n, 3)
        v_opacities, v_depths, v_values = (torch.empty(n), torch.empty(n), torch.empty(n, channels))
        absgrad = None if ctx.absgrad is None else flat(ctx.absgrad)
        with scratch("rows", tiles.pairs * stride, np.float32) as rows:
            launch(
                backward_kernels.blend_backward,
                tiles.tile_order, tiles.offsets, tiles.entries, tiles.records,
                ctx.values, channels, ctx.with_depth, flat(background),
                ctx.camera.width, ctx.camera.height, ctx.masks, ctx.transmittance, ctx.last,
                flat(out_depth), flat(out_alpha), flat(v_colors), flat(v_depth), flat(v_alpha),
                stride, rows, absgrad is not None,
            )  # fmt: skip
            launch(
                backward_kernels.sum_rows,
                _CHUNK, tiles.ranks, tiles.starts, stride, rows, channels, tiles.records, flat(opacities),
                *map(flat, (v_means2d, v_conics, v_opacities, v_depths, v_values)), absgrad,
                items=-(-n // _CHUNK),
            )  # fmt: skip
        v_background = None
        if ctx.needs_input_grad[5]:
            v_background = ((1 - out_alpha)[..., None] * v_colors).sum((0, 1))
        return (v_means2d, v_conics, v_depths, v_opacities, v_values, v_background, None, None)


def _rank_values(tiles: TileLists, depths: Tensor, colors: Tensor) -> np.ndarray:
    """Depths and colours, sorted by rank."""
    values = np.empty(tiles.homes.size * (colors.shape[1] + 1), np.float32)
    launch(
        tile_kernels.rank_values,
        _CHUNK, tiles.homes, flat(depths), flat(colors), colors.shape[1], values,
        items=-(-tiles.homes.size // _CHUNK),
    )  # fmt: skip
    return values


def _blend_pictures(
    projection: Projection,
    colors: Tensor,
    background: Tensor,
    with_depth: bool,
    bookkeeping: bool,
    order: np.ndarray | None = None,
) -> Any:
    """Runs the forward kernel.

    Returns colours, depth and alpha, and for the backward pass values by rank, masks, final transmittance and last
    positions.
    """
    tiles: TileLists = projection.tiles
    width, height = projection.camera.width, projection.camera.height
    channels = colors.shape[1]
    order = tiles.tile_order if order is None else order
    # The kernel does not write tiles that are left out.
    allocate = torch.empty if len(order) == len(tiles.tile_order) else torch.zeros
    values = _rank_values(tiles, projection.depths, colors)
    out_colors = allocate(height, width, channels)
    out_depth = allocate(height, width) if with_depth else torch.zeros(())
    out_alpha = allocate(height, width)
    size = (tiles.offsets.size - 1) * TILE * TILE if bookkeeping else 0
    transmittance, last = np.empty(size, np.float32), np.empty(size, np.float32)
    masks = np.empty(tiles.pairs + LANES, np.int32)
    launch(
        forward_kernels.blend_forward,
        order, tiles.offsets, tiles.entries, tiles.records,
        values, channels, with_depth, flat(background),
        width, height, flat(out_colors), flat(out_depth), flat(out_alpha), masks, transmittance, last,
    )  # fmt: skip
    if not with_depth:
        out_depth = out_depth.expand(height, width)
    return out_colors, out_depth, out_alpha, values, masks, transmittance, last


def blend(
    projection: Projection, colors: Float[Tensor, "N C"], background: Float[Tensor, "C"] | None, depth: bool
) -> Rendering:
    """See `wildgs.rasterize.blend`."""
    if background is None:
        background = colors.new_zeros(colors.shape[1])
    geometry = (projection.means2d, projection.conics, projection.depths, projection.opacities)
    if torch.is_grad_enabled() and any(t.requires_grad for t in (*geometry, colors, background)):
        pictures = _Blend.apply(*geometry, colors, background, projection, depth)
    else:
        pictures = _blend_pictures(projection, colors, background, depth, bookkeeping=False)[:3]
    return Rendering(*pictures)  # type: ignore[misc]


def blend_tiles(
    projection: Projection, colors: Float[Tensor, "N C"], chosen: Bool[Tensor, "R S"]
) -> Rendering:
    """Blends only the chosen tiles; the image is 0 in the others."""
    order: np.ndarray = projection.tiles.tile_order
    background = colors.new_zeros(colors.shape[1])
    order = order[flat(chosen)[order]]
    return Rendering(*_blend_pictures(projection, colors, background, True, False, order)[:3])
