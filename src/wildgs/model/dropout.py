"""Dropout of Gaussians that few photos show, against overfitting to these photos.

Park et al. ("DropGaussian", CVPR 2025) drop a random fraction of all Gaussians in each step when there are few
photos, and scale up the opacities of the others. In a collection of any size some surfaces are shown by few photos
only, so the rate of each Gaussian depends on how many photos show it (`wildgs.engine.photo_counts`). Groups of
neighbouring Gaussians are dropped, because neighbours would compensate for a single one. Training keeps Gaussians
in Morton order, so that consecutive rows are neighbours.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from wildgs.model.config import DropoutConfig

FULL_RATE = 0.25
"""Fraction of `DropoutConfig.photos` up to which the dropout rate is at its maximum."""


def dropout_rates(config: DropoutConfig, photos: Float[Tensor, "N"]) -> Float[Tensor, "N"]:
    """Dropout rate of each Gaussian.

    Args:
        config: The maximum, and the number of photos from which nothing is dropped.
        photos: Effective number of photos that show each Gaussian.
    """
    share = (1 - photos / config.photos) / (1 - FULL_RATE) if config.photos else torch.zeros_like(photos)
    return config.rate * share.clamp(0, 1)


def opacity_factors(rates: Float[Tensor, "N"], neighbours: int) -> Float[Tensor, "N"]:
    """Factors on opacities in one step: 0 for dropped Gaussians, 1 / (1 - rate) for the others.

    Args:
        rates: Dropout rates.
        neighbours: Number of consecutive Gaussians that share a random number.
    """
    count = len(rates)
    drawn = torch.rand(-(-count // neighbours), device=rates.device)
    shift = int(torch.randint(neighbours, ()))  # varies the groups
    drawn = drawn.repeat_interleave(neighbours).roll(shift)[:count]
    return torch.where(drawn < rates, 0.0, 1.0 / (1.0 - rates))
