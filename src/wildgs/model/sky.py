"""The sky: initial Gaussians on a large sphere, since structure from motion finds no points in the sky.

Not in the paper. Without them, densification represents the sky by floaters in front of single cameras. Kulhanek et
al. (WildGaussians, 2024) place points on a sphere, too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from wildgs.model.config import SkyConfig

GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))
COLOR = 0.75
SKY_SHARE = 0.4
"""Rendered depth of the free sky, at least, as a fraction of the sphere's radius."""

CAMERA_MARGIN, FARTHEST = 1.5, 10.0
"""Smallest radius of the sphere as a multiple of the distance of the farthest camera, up to this multiple of the
configured one: a camera even farther away has a wrong pose."""


@dataclass(frozen=True)
class Sky:
    """Sky mask and elevation of points.

    Attributes:
        which: Mask of the points that belong to the sky.
        sine: Sine of every point's elevation, seen from the scene's centre.
    """

    which: Bool[Tensor, "*batch"]
    sine: Float[Tensor, "*batch"]


def find_sky(config: SkyConfig, points: Float[Tensor, "*batch 3"], centre: Float[Tensor, " 3"]) -> Sky | None:
    """Separates sky from scene: points farther than half of the sphere's radius are sky.

    Args:
        config: Configuration of the sphere; None is returned if it has no points.
        points: Points in the aligned frame.
        centre: Centre of the scene.
    """
    if not config.points:
        return None
    return Sky(is_sky(config, points, centre), sine_of_elevation(points, centre))


def is_sky(
    config: SkyConfig, points: Float[Tensor, "*batch 3"], centre: Float[Tensor, " 3"]
) -> Bool[Tensor, "*batch"]:
    """Mask of the points farther from the centre than half of the sphere's radius."""
    # On the CPU, a norm over three columns takes three times as long.
    x, y, z = (points - centre).square().unbind(-1)
    return x + y + z > (0.5 * config.radius) ** 2


def sine_of_elevation(
    points: Float[Tensor, "*batch 3"], centre: Float[Tensor, " 3"]
) -> Float[Tensor, "*batch"]:
    """Sine of the elevation of points in the aligned frame, seen from the scene's centre."""
    offsets = points - centre
    return offsets[..., 2] / offsets.norm(dim=-1).clamp_min(1e-6)


def sky_directions(
    points: Float[Tensor, "*batch 3"], centre: Float[Tensor, " 3"]
) -> Float[Tensor, "*batch 3"]:
    """Unit vectors from the scene's centre to points."""
    return functional.normalize(points - centre, dim=-1)


def sky_points(
    config: SkyConfig, points: Float[Tensor, "P 3"], cameras: Float[Tensor, "V 3"] | None = None
) -> Float[Tensor, "S 3"]:
    """Centres of the sky's Gaussians, on a sphere that contains the cameras.

    A camera outside would see the sky in front of the scene.

    Args:
        config: Configuration of the sphere.
        points: SfM points in the aligned frame.
        cameras: Positions of the photos' cameras.
    """
    centre = points.median(dim=0).values
    distances = (points - centre).norm(dim=1).sort().values
    reach = float(distances[round(0.98 * (len(distances) - 1))])
    radius = max(config.radius, config.reach * reach)
    if cameras is not None and len(cameras):
        farthest = float((cameras - centre).norm(dim=1).max())
        radius = max(radius, min(CAMERA_MARGIN * farthest, FARTHEST * config.radius))
    return centre + radius * shell_directions(config.points, config.lowest)


def shell_directions(count: int, lowest: float) -> Float[Tensor, "count 3"]:
    """Unit vectors distributed evenly over all directions above an elevation (a Fibonacci lattice).

    Args:
        count: Number of vectors.
        lowest: Lowest elevation, degrees.
    """
    index = torch.arange(count, dtype=torch.float64)
    low = math.sin(math.radians(lowest))
    z = 1 - (1 - low) * (index + 0.5) / count
    flat = (1 - z * z).sqrt()
    turn = GOLDEN_ANGLE * index
    return torch.stack([flat * turn.cos(), flat * turn.sin(), z], dim=1).float()
