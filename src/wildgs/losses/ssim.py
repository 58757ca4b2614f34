"""Structural similarity that can be trained on: Numba on the CPU, convolutions elsewhere."""

from __future__ import annotations

from functools import cache
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from wildgs.losses.ssim_kernels import RADIUS, blocks, ssim_backward, ssim_forward
from wildgs.threads import launch

SIGMA = 1.5
C1, C2 = 0.01**2, 0.03**2


@cache
def gaussian_taps(dtype: torch.dtype, device: torch.device | str = "cpu") -> Float[Tensor, "11"]:
    """The one-dimensional window of 11 taps, sigma 1.5, that sums to 1."""
    offsets = torch.arange(-RADIUS, RADIUS + 1, dtype=torch.float64)
    taps = torch.exp(-(offsets**2) / (2 * SIGMA**2))
    return (taps / taps.sum()).to(device=device, dtype=dtype)


def ssim(x: Float[Tensor, "H W C"], y: Float[Tensor, "H W C"]) -> Float[Tensor, ""]:
    """Mean structural similarity (Wang et al. 2004) with 3DGS's conventions, differentiable in both pictures.

    The window is an 11 x 11 Gaussian of sigma 1.5, pictures are padded with zeros, and moments are the
    window's plain weighted means (no sample correction).

    Args:
        x: A picture with data range 1.
        y: The other picture.

    Returns:
        The mean over pixels and channels; 1 for equal pictures.
    """
    if x.device.type == "cpu":
        return _CpuSSIM.apply(x, y)
    return _ssim_by_convolution(x, y)


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


def _ssim_by_convolution(x: Tensor, y: Tensor) -> Tensor:
    return ssim_map(x, y).mean()


def ssim_map(x: Float[Tensor, "H W C"], y: Float[Tensor, "H W C"]) -> Float[Tensor, "H W C"]:
    """Structural similarity of every pixel, same conventions as `ssim`, by two separable convolutions.

    Args:
        x: A picture with data range 1.
        y: The other picture.
    """
    x, y = x.permute(2, 0, 1), y.permute(2, 0, 1)
    taps = gaussian_taps(x.dtype, x.device)
    moments = torch.stack([x, y, x * x, y * y, x * y]).flatten(0, 1)[:, None]
    moments = F.conv2d(moments, taps.view(1, 1, -1, 1), padding=(RADIUS, 0))
    moments = F.conv2d(moments, taps.view(1, 1, 1, -1), padding=(0, RADIUS))
    mean_x, mean_y, square_x, square_y, cross = moments.view(5, *x.shape)
    product, squares = mean_x * mean_y, mean_x**2 + mean_y**2
    covariance, variances = cross - product, square_x + square_y - squares
    similarity = (2 * product + C1) * (2 * covariance + C2) / ((squares + C1) * (variances + C2))
    return similarity.permute(1, 2, 0)
