"""The sky: a far shell of Gaussians, since photos are full of sky and structure from motion finds no point in it.

Not in the paper. Without it, sky is built of what densification can reach, which is floaters right before single
cameras. Others have done the same: Kulhanek et al. 2024 (WildGaussians) place points on a sphere for it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from wildgs.model.config import SkyConfig

GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))
COLOR = 0.75


@dataclass(frozen=True)
class Sky:
    """What is sky among points of the scene.

    Attributes:
        which: Which points are.
        sine: Of every point's elevation, seen from the scene's centre.
    """

    which: Bool[Tensor, "*batch"]
    sine: Float[Tensor, "*batch"]


def find_sky(config: SkyConfig, points: Float[Tensor, "*batch 3"], centre: Float[Tensor, " 3"]) -> Sky | None:
    """Tells the sky from the scene: it is further away than half of the shell's radius.

    Args:
        config: The shell; without points there is no sky.
        points: In the aligned frame.
        centre: Of the scene.
    """
    if not config.points:
        return None
    offsets = points - centre
    distances = offsets.norm(dim=-1)
    return Sky(distances > 0.5 * config.radius, offsets[..., 2] / distances.clamp_min(1e-6))


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
