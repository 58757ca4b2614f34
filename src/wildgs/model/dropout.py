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

FULL_SHARE = 0.25
"""Fraction of the limiting number of photos up to which `rareness` is 1."""


def rareness(photos: Float[Tensor, "N"], limit: int) -> Float[Tensor, "N"]:
    """1 for Gaussians that at most a quarter of `limit` photos show, falling linearly to 0 at `limit`.

    Args:
        photos: Effective number of photos that show each Gaussian.
        limit: Number of photos; 0 gives 0 for all.
    """
    share = (1 - photos / limit) / (1 - FULL_SHARE) if limit else torch.zeros_like(photos)
    return share.clamp(0, 1)


def dropout_rates(config: DropoutConfig, photos: Float[Tensor, "N"]) -> Float[Tensor, "N"]:
    """Dropout rate of each Gaussian.

    Args:
        config: The maximum, and the number of photos from which nothing is dropped.
        photos: Effective number of photos that show each Gaussian.
    """
    return config.rate * rareness(photos, config.photos)


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
