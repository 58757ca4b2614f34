"""The depth loss: the rendered depth should follow a monocular estimate up to scale and shift."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

MIN_PIXELS = 64
_MIN_RELATIVE_VARIANCE = 1e-9  # float32 rounding of a constant map leaves about 1e-14


def depth_correlation(
    depth: Float[Tensor, "H W"],
    disparity: Float[Tensor, "H W"],
    selection: Bool[Tensor, "H W"],
    min_pixels: int = MIN_PIXELS,
) -> Float[Tensor, ""]:
    """``1 + ρ(depth, disparity)`` over the selected pixels, ρ being Pearson's correlation (the paper's L^D).

    A monocular network gives disparity (large = near), so right geometry has ρ near -1. Pixels without an
    estimate (disparity 0) are left out. Where fewer than `min_pixels` remain or one of the maps is constant,
    ρ has no meaning: the loss is 0 and has no gradient.

    Args:
        depth: Rendered expected depth, world units along the camera's z axis.
        disparity: Estimate in arbitrary scale and shift; 0 where there is none.
        selection: Pixels that count: static (``M > Th``) and covered by the render. Passes no gradient.
        min_pixels: Fewest pixels that make a correlation.

    Returns:
        0 (same order and linear) to 2 (inverted).
    """
    chosen = selection & (disparity > 0)
    count = chosen.sum()
    divisor = count.clamp(min=1)
    depth_offset, depth_variance, depth_power = _centred(depth, chosen, divisor)
    estimate_offset, estimate_variance, estimate_power = _centred(disparity.to(depth), chosen, divisor)
    meaningful = (
        (count >= min_pixels)
        & (depth_variance > _MIN_RELATIVE_VARIANCE * depth_power)
        & (estimate_variance > _MIN_RELATIVE_VARIANCE * estimate_power)
    )
    # Replaced before the root and the division: their gradients at 0 would be NaN even where unused.
    variances = torch.where(meaningful, depth_variance * estimate_variance, 1.0)
    correlation = (depth_offset * estimate_offset).sum() / divisor / variances.sqrt()
    return torch.where(meaningful, 1 + correlation, 0.0)


def _centred(values: Tensor, chosen: Tensor, count: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Offsets from the mean at chosen pixels (0 elsewhere), their variance and the squares' mean."""
    values = torch.where(chosen, values, 0.0)
    values = values / values.detach().abs().amax().clamp(min=torch.finfo(values.dtype).tiny)
    mean = values.sum() / count
    offset = torch.where(chosen, values - mean, 0.0)
    return offset, offset.square().sum() / count, values.detach().square().sum() / count
