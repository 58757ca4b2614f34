"""Triton kernels that sample three planes at points, and scatter gradients to the planes, channels last.

The gradient of grid_sample adds 384 numbers per point (3 planes, 4 corners, 32 channels) to channel-first planes,
each at a different address; here the channels of a cell are contiguous.
"""

# pyright: reportMissingImports=false, reportIndexIssue=false

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

POINTS = 32
"""Points per program."""


@triton.jit
def _corner(coordinate, resolution):
    """Lower cell and weight of the upper one, clamped to the border as grid_sample's 'border' padding."""
    x = (coordinate + 1.0) * (0.5 * resolution) - 0.5
    x = tl.minimum(tl.maximum(x, 0.0), resolution - 1.0)
    low = tl.minimum(x.to(tl.int32), tl.maximum(resolution - 2, 0))
    return low, x - low.to(tl.float32)


@triton.jit
def _sample(planes, points, out, count, resolution, channels, POINTS: tl.constexpr, WIDTH: tl.constexpr):
    """out[n] = sum of the planes' bilinear samples; planes are [3, R, R, C], points [N, 3]."""
    n = tl.program_id(0) * POINTS + tl.arange(0, POINTS)
    c = tl.arange(0, WIDTH)
    valid = n < count
    both = valid[:, None] & (c < channels)[None, :]
    upper = tl.minimum(resolution - 1, 1)
    total = tl.zeros([POINTS, WIDTH], tl.float32)
    for plane in tl.static_range(3):
        column, right = _corner(tl.load(points + 3 * n + plane, mask=valid, other=0.0), resolution)
        row, down = _corner(tl.load(points + 3 * n + (plane + 1) % 3, mask=valid, other=0.0), resolution)
        for corner in tl.static_range(4):
            r = row + (corner // 2) * upper
            q = column + (corner % 2) * upper
            vertical = down if corner // 2 == 1 else 1.0 - down
            horizontal = right if corner % 2 == 1 else 1.0 - right
            cell = ((plane * resolution + r) * resolution + q) * channels
            values = tl.load(planes + cell[:, None] + c[None, :], mask=both, other=0.0)
            total += (vertical * horizontal)[:, None] * values
    tl.store(out + (n * channels)[:, None] + c[None, :], total, mask=both)


@triton.jit
def _scatter(gradient, points, out, count, resolution, channels, POINTS: tl.constexpr, WIDTH: tl.constexpr):
    """Adds the gradient of `_sample` by its planes to `out` [3, R, R, C]; one program per block and plane."""
    n = tl.program_id(0) * POINTS + tl.arange(0, POINTS)
    plane = tl.program_id(1)
    c = tl.arange(0, WIDTH)
    valid = n < count
    both = valid[:, None] & (c < channels)[None, :]
    upper = tl.minimum(resolution - 1, 1)
    values = tl.load(gradient + (n * channels)[:, None] + c[None, :], mask=both, other=0.0)
    column, right = _corner(tl.load(points + 3 * n + plane, mask=valid, other=0.0), resolution)
    row, down = _corner(tl.load(points + 3 * n + (plane + 1) % 3, mask=valid, other=0.0), resolution)
    for corner in tl.static_range(4):
        r = row + (corner // 2) * upper
        q = column + (corner % 2) * upper
        vertical = down if corner // 2 == 1 else 1.0 - down
        horizontal = right if corner % 2 == 1 else 1.0 - right
        cell = ((plane * resolution + r) * resolution + q) * channels
        weight = (vertical * horizontal)[:, None]
        tl.atomic_add(out + cell[:, None] + c[None, :], weight * values, mask=both, sem="relaxed")


class TritonSample(torch.autograd.Function):
    """Bilinear samples of three float32 planes, summed; see `wildgs.model.triplane.sample_planes`."""

    @staticmethod
    def forward(ctx: Any, planes: Tensor, points: Tensor) -> Tensor:
        """Computes [N, C] from planes [3, C, R, R] and points [N, 3]."""
        cells = planes.permute(0, 2, 3, 1).contiguous()
        points = points.contiguous()
        resolution, channels = cells.shape[1], cells.shape[3]
        out = points.new_empty(len(points), channels)
        if len(points):
            grid = (triton.cdiv(len(points), POINTS),)
            width = triton.next_power_of_2(channels)
            _sample[grid](cells, points, out, len(points), resolution, channels, POINTS=POINTS, WIDTH=width)
        ctx.save_for_backward(points)
        ctx.shape = cells.shape
        return out

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        """The gradient of the planes; points get none."""
        (points,) = ctx.saved_tensors
        resolution, channels = ctx.shape[1], ctx.shape[3]
        out = points.new_zeros(ctx.shape)
        if len(points):
            grid = (triton.cdiv(len(points), POINTS), 3)
            width = triton.next_power_of_2(channels)
            gradient = gradients[0].contiguous()
            _scatter[grid](
                gradient, points, out, len(points), resolution, channels, POINTS=POINTS, WIDTH=width
            )
        return out.permute(0, 3, 1, 2), None
