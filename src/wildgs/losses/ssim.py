"""Differentiable structural similarity: Numba on the CPU, Triton or convolutions on CUDA."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from wildgs import features
from wildgs.losses.ssim_kernels import RADIUS, blocks, ssim_backward, ssim_forward
from wildgs.threads import launch

SIGMA = 1.5
C1, C2 = 0.01**2, 0.03**2


@cache
def gaussian_taps(dtype: torch.dtype, device: torch.device | str = "cpu") -> Float[Tensor, "11"]:
    """The 1D Gaussian window of 11 taps with sigma 1.5 and sum 1."""
    offsets = torch.arange(-RADIUS, RADIUS + 1, dtype=torch.float64)
    taps = torch.exp(-(offsets**2) / (2 * SIGMA**2))
    return (taps / taps.sum()).to(device=device, dtype=dtype)


def ssim(x: Float[Tensor, "H W C"], y: Float[Tensor, "H W C"]) -> Float[Tensor, ""]:
    """Mean structural similarity (Wang et al. 2004) with 3DGS's conventions, differentiable in both images.

    The window is an 11 x 11 Gaussian of sigma 1.5, images are padded with zeros, and moments are weighted means
    without sample correction.

    Args:
        x: An image with data range 1.
        y: The other image.

    Returns:
        The mean over pixels and channels; 1 for equal images.
    """
    if x.device.type == "cpu":
        return _CpuSSIM.apply(x, y)
    if x.dtype == torch.float32 and features.has_triton("triton_ssim", lambda: _triton(x[:1, :1], y[:1, :1])):
        return _triton(x, y)
    return _ConvolutionSSIM.apply(x, y)


def _triton(x: Tensor, y: Tensor) -> Tensor:
    from wildgs.losses.ssim_triton import TritonSSIM

    return TritonSSIM.apply(x, y)


class _CpuSSIM(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, y: Tensor) -> Tensor:
        x, y = x.contiguous(), y.contiguous()
        height, width, channels = x.shape
        taps = gaussian_taps(x.dtype).numpy()
        derivatives = torch.empty(4, height, width * channels, dtype=x.dtype)
        row_sums = torch.empty(height, dtype=x.dtype)
        c1, c2 = taps.dtype.type(C1), taps.dtype.type(C2)
        pictures = _matrix(x), _matrix(y)
        launch(
            ssim_forward,
            *pictures,
            taps,
            c1,
            c2,
            channels,
            derivatives.numpy(),
            row_sums.numpy(),
            items=blocks(height),
        )
        ctx.save_for_backward(x, y, derivatives)
        return (row_sums.sum(dtype=torch.float64) / x.numel()).to(x.dtype)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, Tensor]:
        x, y, derivatives = ctx.saved_tensors
        taps = gaussian_taps(x.dtype).numpy()
        scale = taps.dtype.type(grads[0].item() / x.numel())
        grad_x, grad_y = torch.empty_like(x), torch.empty_like(y)
        pictures, grads_out = (_matrix(x), _matrix(y)), (_matrix(grad_x), _matrix(grad_y))
        launch(
            ssim_backward,
            *pictures,
            taps,
            scale,
            x.shape[2],
            derivatives.numpy(),
            *grads_out,
            items=blocks(x.shape[0]),
        )
        return grad_x, grad_y


def _matrix(picture: Tensor) -> Any:
    return picture.detach().numpy().reshape(picture.shape[0], -1)


class _ConvolutionSSIM(torch.autograd.Function):
    """Value and gradient by convolutions in float32, for devices without a kernel."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, y: Tensor) -> Tensor:
        similarity, derivatives = _similarity(x.permute(2, 0, 1), y.permute(2, 0, 1))
        ctx.save_for_backward(x, y, derivatives)
        return similarity.mean()

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, Tensor]:
        x, y, derivatives = ctx.saved_tensors
        # The window is symmetric, so the filter with zero padding is self-adjoint.
        by_x, by_y, by_square, by_cross = _filter(derivatives * (grads[0] / x.numel())).permute(0, 2, 3, 1)
        return by_x + 2 * by_square * x + by_cross * y, by_y + 2 * by_square * y + by_cross * x


def ssim_map(x: Float[Tensor, "H W C"], y: Float[Tensor, "H W C"]) -> Float[Tensor, "H W C"]:
    """Structural similarity of every pixel, with the conventions of `ssim`.

    Args:
        x: An image with data range 1.
        y: The other image.
    """
    return _similarity(x.permute(2, 0, 1), y.permute(2, 0, 1))[0].permute(1, 2, 0)


def _similarity(
    x: Float[Tensor, "C H W"], y: Float[Tensor, "C H W"]
) -> tuple[Float[Tensor, "C H W"], Float[Tensor, "4 C H W"]]:
    """The similarity and its derivatives with respect to E[x], E[y], E[x^2] (equal to E[y^2]) and E[xy]."""
    mean_x, mean_y, square_x, square_y, cross = _filter(torch.stack([x, y, x * x, y * y, x * y]))
    product, squares = mean_x * mean_y, mean_x**2 + mean_y**2
    a, b = 2 * product + C1, 2 * (cross - product) + C2
    c, d = squares + C1, square_x + square_y - squares + C2
    inverse = 1 / (c * d)
    similarity = a * b * inverse
    by_b, by_d = a * inverse, -similarity * c * inverse
    by_a, by_c = b * inverse - by_b, -similarity * d * inverse - by_d
    by_x, by_y = 2 * (mean_y * by_a + mean_x * by_c), 2 * (mean_x * by_a + mean_y * by_c)
    return similarity, torch.stack([by_x, by_y, by_d, 2 * by_b])


def _filter(maps: Float[Tensor, "M C H W"]) -> Float[Tensor, "M C H W"]:
    """Weighted means over the window.

    TF32 is disabled, because with ten bits of mantissa E[x^2] - E[x]^2 cancels (an SSIM of 0.932 became 0.901).
    """
    taps = gaussian_taps(maps.dtype, maps.device)
    with _full_precision():
        rows = F.conv2d(maps.flatten(0, 1)[:, None], taps.view(1, 1, -1, 1), padding=(RADIUS, 0))
        return F.conv2d(rows, taps.view(1, 1, 1, -1), padding=(0, RADIUS)).view(maps.shape)


@contextmanager
def _full_precision() -> Iterator[None]:
    """Disables TF32 for convolutions, by torch's newer setting if there is one (the older one then fails)."""
    cudnn: Any = torch.backends.cudnn
    place, name, value = (
        (cudnn.conv, "fp32_precision", "ieee") if hasattr(cudnn, "conv") else (cudnn, "allow_tf32", False)
    )
    before = getattr(place, name)
    setattr(place, name, value)
    try:
        yield
    finally:
        setattr(place, name, before)
