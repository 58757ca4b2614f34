"""The sky: a far shell of Gaussians, since photos are full of sky and structure from motion finds no point in it.

Not in the paper. Without it, sky is built of what densification can reach, which is floaters right before single
cameras. Others have done the same: Kulhanek et al. 2024 (WildGaussians) place points on a sphere for it.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from wildgs.model.config import SkyConfig

GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))
COLOR = 0.75


def sky_points(config: SkyConfig, points: Float[Tensor, "P 3"]) -> Float[Tensor, "S 3"]:
    """Centres of the sky's Gaussians.

    Args:
        config: The shell.
        points: The scene's SfM points in the aligned frame, +z up.
    """
    centre = points.median(dim=0).values
    distances = (points - centre).norm(dim=1).sort().values
    reach = float(distances[round(0.98 * (len(distances) - 1))])
    radius = max(config.radius, config.reach * reach)
    return centre + radius * shell_directions(config.points, config.lowest)


def shell_directions(count: int, lowest: float) -> Float[Tensor, "count 3"]:
    """Unit vectors spread evenly over all directions above an elevation (a Fibonacci lattice), +z up.

    Args:
        count: How many.
        lowest: Least elevation, degrees.
    """
    index = torch.arange(count, dtype=torch.float64)
    low = math.sin(math.radians(lowest))
    z = 1 - (1 - low) * (index + 0.5) / count
    flat = (1 - z * z).sqrt()
    turn = GOLDEN_ANGLE * index
    return torch.stack([flat * turn.cos(), flat * turn.sin(), z], dim=1).float()
