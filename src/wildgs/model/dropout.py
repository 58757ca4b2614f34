"""Dropout of Gaussians, against Gaussians that fit a few photos by heart.

With few photos, Gaussians near a camera explain its photo alone. Park et al. ("DropGaussian", CVPR 2025) leave out
a random share of all Gaussians in each step, more and more of them, and scale the opacities of the others up. Here
runs of neighbours are left out, because the neighbours of a single Gaussian make up for it. Training keeps
Gaussians in Morton order, so that a run of rows is a neighbourhood.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def opacity_factors(count: int, rate: float, neighbours: int, device: torch.device) -> Float[Tensor, " N"]:
    """What opacities are multiplied by in one step: 0 for Gaussians that are left out, more than 1 for the others.

    Args:
        count: N.
        rate: Share that is left out.
        neighbours: Length of the runs of rows that are left out together.
        device: Where the factors go.
    """
    runs = -(-count // neighbours)
    kept = (torch.rand(runs, device=device) >= rate).to(torch.float32) / (1.0 - rate)
    shift = int(torch.randint(neighbours, ()))  # or the same rows would always share a run
    return kept.repeat_interleave(neighbours).roll(shift)[:count]
