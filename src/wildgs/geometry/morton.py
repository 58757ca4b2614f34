"""Morton order: sorts points so that neighbours in space are close in memory."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

MAX_BITS = 21
"""Maximum number of bits per coordinate, so that three coordinates fit into 64 bits."""


def morton_order(points: Float[Tensor, "N 3"], *, bits: int = 10, outside: float = 0.02) -> Int[Tensor, " N"]:
    """Indices that sort points along the Z-order curve (Morton 1966).

    The curve divides a bounding box of most points into cells; points outside belong to the nearest cell. Points in
    the same cell keep their order.

    Args:
        points: World coordinates; NaN sorts first.
        bits: The box has ``2**bits`` cells per side; at most 21.
        outside: Share of the points that lie outside the box on each side of each axis.
    """
    if len(points) == 0:
        return torch.zeros(0, dtype=torch.long, device=points.device)
    ordered = points.nan_to_num().sort(dim=0).values
    last = len(points) - 1
    low, high = ordered[round(outside * last)], ordered[round((1 - outside) * last)]
    share = (points - low) / (high - low).clamp_min(torch.finfo(points.dtype).tiny)
    cells = (share.nan_to_num().clamp(0, 1) * (2**bits - 1)).long()
    x, y, z = _spread(cells).unbind(1)
    return (x | (y << 1) | (z << 2)).argsort(stable=True)


def _spread(numbers: Int[Tensor, "..."]) -> Int[Tensor, "..."]:
    """Inserts two zero bits after every bit, for numbers of at most `MAX_BITS` bits."""
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        numbers = (numbers | (numbers << shift)) & mask
    return numbers
