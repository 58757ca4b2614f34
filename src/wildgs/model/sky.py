"""The sky: a far shell of Gaussians, since photos are full of sky and structure from motion finds no point in it.

Not in the paper. Without it, sky is built of what densification can reach, which is floaters right before single
cameras. Others have done the same: Kulhanek et al. 2024 (WildGaussians) place points on a sphere for it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))
COLOR = 0.75


@dataclass(frozen=True)
class SkyConfig:
    """The shell of Gaussians that stands for the sky at the start.

    Attributes:
        points: How many; 0 leaves the sky to densification, as the paper does.
        radius: Of the shell, in units of the aligned frame (photos' median depth); more where the scene's points
            reach further.
        reach: The shell lies at this multiple of the distance within which nearly all points are, at least.
        lowest: Elevation at which the shell ends, degrees. Below the horizon it closes the scene behind ground that
            too few photos show: such holes are as dark as the background otherwise.
        opacity: Of its Gaussians at the start.
    """

    points: int = 5000
    radius: float = 10.0
    reach: float = 2.0
    lowest: float = -90.0
    opacity: float = 0.5


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
