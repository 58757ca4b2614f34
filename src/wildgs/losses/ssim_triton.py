"""Triton kernels of the structural similarity and its gradient, each as a vertical and a horizontal pass.

An image is a matrix of H rows and L = W * C numbers (channels interleaved), as in `ssim_kernels`: the vertical
window steps by L, the horizontal one by C. All arithmetic is in float32.
"""

# pyright: reportMissingImports=false, reportIndexIssue=false

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

BLOCK = 256
_RADIUS = tl.constexpr(5)
_TAPS = tl.constexpr(11)
_C1, _C2 = tl.constexpr(0.01**2), tl.constexpr(0.03**2)


@triton.jit
def _vertical_moments(x, y, taps, out, count, length, BLOCK: tl.constexpr):
    """E[x], E[y], E[x^2], E[y^2] and E[xy] over columns of the window; `out` is [5, H, L]."""
    place = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    sum_x = tl.zeros([BLOCK], tl.float32)
    sum_y = tl.zeros([BLOCK], tl.float32)
    square_x = tl.zeros([BLOCK], tl.float32)
    square_y = tl.zeros([BLOCK], tl.float32)
    cross = tl.zeros([BLOCK], tl.float32)
    for k in tl.static_range(_TAPS):
        other = place + (k - _RADIUS) * length
        inside = (place < count) & (other >= 0) & (other < count)
        u = tl.load(x + other, mask=inside, other=0.0)
        v = tl.load(y + other, mask=inside, other=0.0)
        weight = tl.load(taps + k)
        sum_x += weight * u
        sum_y += weight * v
        square_x += weight * u * u
        square_y += weight * v * v
        cross += weight * u * v
    valid = place < count
    tl.store(out + place, sum_x, mask=valid)
    tl.store(out + count + place, sum_y, mask=valid)
    tl.store(out + 2 * count + place, square_x, mask=valid)
    tl.store(out + 3 * count + place, square_y, mask=valid)
    tl.store(out + 4 * count + place, cross, mask=valid)


@triton.jit
def _similarity(moments, taps, derivatives, sums, count, length, channels, BLOCK: tl.constexpr):
    """Sum of the similarity over a block, and derivatives [4, H, L] with respect to E[x], E[y], E[x^2], E[xy]."""
    place = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    column = place % length
    mean_x = tl.zeros([BLOCK], tl.float32)
    mean_y = tl.zeros([BLOCK], tl.float32)
    square_x = tl.zeros([BLOCK], tl.float32)
    square_y = tl.zeros([BLOCK], tl.float32)
    cross = tl.zeros([BLOCK], tl.float32)
    for k in tl.static_range(_TAPS):
        shift = (k - _RADIUS) * channels
        inside = (place < count) & (column + shift >= 0) & (column + shift < length)
        weight = tl.load(taps + k)
        other = moments + place + shift
        mean_x += weight * tl.load(other, mask=inside, other=0.0)
        mean_y += weight * tl.load(other + count, mask=inside, other=0.0)
        square_x += weight * tl.load(other + 2 * count, mask=inside, other=0.0)
        square_y += weight * tl.load(other + 3 * count, mask=inside, other=0.0)
        cross += weight * tl.load(other + 4 * count, mask=inside, other=0.0)
    a = 2 * mean_x * mean_y + _C1
    b = 2 * (cross - mean_x * mean_y) + _C2
    c = mean_x * mean_x + mean_y * mean_y + _C1
    d = square_x + square_y - mean_x * mean_x - mean_y * mean_y + _C2
    inverse = 1 / (c * d)
    value = a * b * inverse
    by_b = a * inverse
    by_d = -value * c * inverse
    by_a = b * inverse - by_b
    by_c = -value * d * inverse - by_d
    valid = place < count
    tl.store(derivatives + place, 2 * (mean_y * by_a + mean_x * by_c), mask=valid)
    tl.store(derivatives + count + place, 2 * (mean_x * by_a + mean_y * by_c), mask=valid)
    tl.store(derivatives + 2 * count + place, by_d, mask=valid)
    tl.store(derivatives + 3 * count + place, 2 * by_b, mask=valid)
    tl.store(sums + tl.program_id(0), tl.sum(tl.where(valid, value, 0.0), axis=0))


@triton.jit
def _vertical_adjoint(derivatives, taps, scale, out, count, length, BLOCK: tl.constexpr):
    """Filters the four derivatives, times a scale, along columns."""
    place = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    factor = tl.load(scale)
    for part in tl.static_range(4):
        total = tl.zeros([BLOCK], tl.float32)
        for k in tl.static_range(_TAPS):
            other = place + (k - _RADIUS) * length
            inside = (place < count) & (other >= 0) & (other < count)
            total += tl.load(taps + k) * tl.load(derivatives + part * count + other, mask=inside, other=0.0)
        tl.store(out + part * count + place, factor * total, mask=place < count)


@triton.jit
def _horizontal_adjoint(columns, taps, x, y, grad_x, grad_y, count, length, channels, BLOCK: tl.constexpr):
    """Gradients with respect to both images, from the result of `_vertical_adjoint`."""
    place = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    column = place % length
    by_x = tl.zeros([BLOCK], tl.float32)
    by_y = tl.zeros([BLOCK], tl.float32)
    by_square = tl.zeros([BLOCK], tl.float32)
    by_cross = tl.zeros([BLOCK], tl.float32)
    for k in tl.static_range(_TAPS):
        shift = (k - _RADIUS) * channels
        inside = (place < count) & (column + shift >= 0) & (column + shift < length)
        weight = tl.load(taps + k)
        other = columns + place + shift
        by_x += weight * tl.load(other, mask=inside, other=0.0)
        by_y += weight * tl.load(other + count, mask=inside, other=0.0)
        by_square += weight * tl.load(other + 2 * count, mask=inside, other=0.0)
        by_cross += weight * tl.load(other + 3 * count, mask=inside, other=0.0)
    valid = place < count
    u = tl.load(x + place, mask=valid, other=0.0)
    v = tl.load(y + place, mask=valid, other=0.0)
    tl.store(grad_x + place, by_x + 2 * by_square * u + by_cross * v, mask=valid)
    tl.store(grad_y + place, by_y + 2 * by_square * v + by_cross * u, mask=valid)


class TritonSSIM(torch.autograd.Function):
    """Mean structural similarity of two float32 images [H, W, C]; see `wildgs.losses.ssim.ssim`."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, y: Tensor) -> Tensor:
        """The mean over pixels and channels, without synchronisation."""
        from wildgs.losses.ssim import gaussian_taps

        x, y = x.contiguous(), y.contiguous()
        _, width, channels = x.shape
        count, length = x.numel(), width * channels
        taps = gaussian_taps(torch.float32, x.device)
        grid = (triton.cdiv(count, BLOCK),)
        moments, derivatives = x.new_empty(5, count), x.new_empty(4, count)
        sums = x.new_empty(grid[0])
        _vertical_moments[grid](x, y, taps, moments, count, length, BLOCK=BLOCK)
        _similarity[grid](moments, taps, derivatives, sums, count, length, channels, BLOCK=BLOCK)
        ctx.save_for_backward(x, y, derivatives)
        return sums.sum() / count

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, Tensor]:
        """Gradients with respect to both images."""
        from wildgs.losses.ssim import gaussian_taps

        x, y, derivatives = ctx.saved_tensors
        _, width, channels = x.shape
        count, length = x.numel(), width * channels
        taps = gaussian_taps(torch.float32, x.device)
        grid = (triton.cdiv(count, BLOCK),)
        columns = torch.empty_like(derivatives)
        scale = (grads[0].float() / count).reshape(1)
        _vertical_adjoint[grid](derivatives, taps, scale, columns, count, length, BLOCK=BLOCK)
        grad_x, grad_y = torch.empty_like(x), torch.empty_like(y)
        _horizontal_adjoint[grid](columns, taps, x, y, grad_x, grad_y, count, length, channels, BLOCK=BLOCK)
        return grad_x, grad_y
