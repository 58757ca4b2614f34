"""An order in which points that are near in space are near in memory."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

BITS = 10
"""Cells per side are two to the power of this."""


def morton_order(points: Float[Tensor, "N 3"]) -> Int[Tensor, " N"]:
    """Indices that sort points along the Z-shaped curve of Morton (1966).

    The curve's cells divide the box between the 2% and the 98% point of each axis; what lies outside counts to the
    cells at its border. Points of one cell keep their order.

    Args:
        points: World coordinates; those that are no numbers come first.
    """
    if len(points) == 0:
        return torch.zeros(0, dtype=torch.long, device=points.device)
    ordered = points.nan_to_num().sort(dim=0).values
    last = len(points) - 1
    low, high = ordered[round(0.02 * last)], ordered[round(0.98 * last)]
    share = (points - low) / (high - low).clamp_min(torch.finfo(points.dtype).tiny)
    cells = (share.nan_to_num().clamp(0, 1) * (2**BITS - 1)).long()
    x, y, z = _spread(cells).unbind(1)
    return (x | (y << 1) | (z << 2)).argsort(stable=True)


def _spread(numbers: Int[Tensor, "..."]) -> Int[Tensor, "..."]:
    """Two empty bits after every bit, for numbers of at most ten bits."""
    for shift, mask in ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249)):
        numbers = (numbers | (numbers << shift)) & mask
    return numbers
