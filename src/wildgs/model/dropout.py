"""Dropout of Gaussians, against overfitting to few photos.

With few photos, Gaussians close to a camera overfit its photo. Park et al. ("DropGaussian", CVPR 2025) drop a
random, growing fraction of all Gaussians in each step and scale up the opacities of the others. Here groups of
neighbouring Gaussians are dropped, because neighbours would compensate for a single one. Training keeps Gaussians
in Morton order, so that consecutive rows are neighbours.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def opacity_factors(count: int, rate: float, neighbours: int, device: torch.device) -> Float[Tensor, " N"]:
    """Factors on opacities in one step: 0 for dropped Gaussians, above 1 for the others.

    Args:
        count: Number of Gaussians, N.
        rate: Dropout rate.
        neighbours: Number of consecutive Gaussians that are dropped together.
        device: Device of the factors.
    """
    runs = -(-count // neighbours)
    kept = (torch.rand(runs, device=device) >= rate).to(torch.float32) / (1.0 - rate)
    shift = int(torch.randint(neighbours, ()))  # varies the groups
    return kept.repeat_interleave(neighbours).roll(shift)[:count]
