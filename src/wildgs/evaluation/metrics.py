"""Scores of a render against the truth, on pictures rounded to 8 bits."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from wildgs.losses.ssim import ssim_map

MAX_PSNR = 100.0
"""What equal pictures score, in dB, so that means stay finite."""


def to_8bit(picture: Float[Tensor, "H W 3"]) -> UInt8[Tensor, "H W 3"]:
    """Clamp to 0..1 and round to 8 bits, as a picture file holds it; what is not a number becomes black."""
    return (picture.nan_to_num(0.0, 1.0, 0.0).clamp(0, 1) * 255).round().to(torch.uint8)


def psnr(
    render: UInt8[Tensor, "H W 3"],
    truth: UInt8[Tensor, "H W 3"],
    keep: Bool[Tensor, "H W"] | None = None,
) -> float:
    """Peak signal-to-noise ratio in dB, from the mean square error over all pixels and channels.

    Args:
        render: What is scored.
        truth: What it should be.
        keep: Pixels that count; None for all.

    Returns:
        Decibels, at most `MAX_PSNR`.
    """
    square = ((render.double() - truth.double()) / 255).square()
    error = (square if keep is None else square[keep]).mean()
    return min(float(-10 * torch.log10(error)), MAX_PSNR)


def structural_similarity(
    render: UInt8[Tensor, "H W 3"],
    truth: UInt8[Tensor, "H W 3"],
    keep: Bool[Tensor, "H W"] | None = None,
) -> float:
    """SSIM as 3DGS and its descendants report it: Gaussian window of 11, sigma 1.5, data range 1.

    Windows at the border reach into zeros (3DGS's choice; others drop the border's 5 pixels instead), moments
    are not corrected for the sample's size, and the map is averaged over pixels and channels. In double
    precision.

    Args:
        render: What is scored.
        truth: What it should be.
        keep: Pixels whose windows count; None for all.
    """
    similarity = ssim_map(render.double() / 255, truth.double() / 255)
    return float((similarity if keep is None else similarity[keep]).mean())
