"""The ground where nothing is known of it: the plane that known ground lies in, continued around the cameras.

Photographers look up at a landmark, and of the paving at their feet few photos show any one place. What none or one
of them shows has no points, and a view that looks there sees through the scene to whatever lies behind.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int, UInt8
from scipy.spatial import KDTree
from torch import Tensor

_HYPOTHESES = 512
_STEEPEST = 0.15
"""Slope of a ground, at most: steeper planes are walls, roofs and flights of stairs."""
_LEAST_SHARE = 0.2
"""Of the points below the cameras, that lie in the plane: less is no ground but some level thing."""
_LEAST_ABOVE = 0.9
"""Of the cameras, that stand above it."""
_LEAST_POINTS = 50
_MAX_POINTS = 20_000  # in the search; more make no better plane and a table of 512 times as many numbers


@dataclass(frozen=True)
class GroundConfig:
    """Gaussians that continue the ground at the start, where it is level and known in part.

    Attributes:
        points: At most so many; 0 leaves holes, as the paper does.
        spacing: Between them, in units of the aligned frame (photos' median depth).
        reach: How far around the cameras the ground is continued, likewise.
        tolerance: Height within which a point belongs to the plane, likewise.
    """

    points: int = 6000
    spacing: float = 0.04
    reach: float = 1.0
    tolerance: float = 0.03


@dataclass(frozen=True)
class Plane:
    """A nearly level plane: ``z = slope_x x + slope_y y + height``.

    Attributes:
        coefficients: slope_x, slope_y, height.
        members: Which of the points lie in it.
    """

    coefficients: Float[Tensor, "3"]
    members: Bool[Tensor, " P"]

    def heights(self, places: Float[Tensor, "Q 2"]) -> Float[Tensor, " Q"]:
        """The plane's z at places x, y."""
        return places @ self.coefficients[:2] + self.coefficients[2]


def ground_points(
    points: Float[Tensor, "P 3"],
    colors: UInt8[Tensor, "P 3"],
    centers: Float[Tensor, "V 3"],
    config: GroundConfig,
    seed: int = 0,
) -> tuple[Float[Tensor, "G 3"], UInt8[Tensor, "G 3"]]:
    """Points that continue the ground where it has none.

    Args:
        points: What is known of the scene, in the aligned frame (+z up).
        colors: Its colours; new points take those of the nearest known ground.
        centers: Where the cameras are.
        config: How many, how dense, how far.
        seed: Of the search for the plane.

    Returns:
        Positions and colours. Empty where the points show no ground.
    """
    nothing = points[:0], colors[:0]
    if config.points == 0 or len(centers) == 0:
        return nothing
    plane = find_ground(points, centers, config.tolerance, torch.Generator().manual_seed(seed))
    if plane is None:
        return nothing
    feet, known = centers[:, :2], points[plane.members]
    low, high = feet.min(dim=0).values - config.reach, feet.max(dim=0).values + config.reach
    x, y = (torch.arange(float(low[i]), float(high[i]), config.spacing) for i in range(2))
    places = torch.cartesian_prod(x, y)
    distance = torch.from_numpy(KDTree(feet.numpy()).query(places.numpy())[0])
    gap, nearest = (torch.from_numpy(found) for found in KDTree(known[:, :2].numpy()).query(places.numpy()))
    chosen: Int[Tensor, " G"] = ((distance < config.reach) & (gap > config.spacing)).nonzero()[:, 0]
    chosen = chosen[distance[chosen].argsort(stable=True)[: config.points]]
    heights = plane.heights(places[chosen])
    return torch.cat([places[chosen], heights[:, None]], dim=1), colors[plane.members][nearest[chosen]]


def find_ground(
    points: Float[Tensor, "P 3"], centers: Float[Tensor, "V 3"], tolerance: float, generator: torch.Generator
) -> Plane | None:
    """The level plane under the cameras in which most points lie (RANSAC, then least squares).

    Returns:
        None where too few points lie in any one plane, or cameras stand below it.
    """
    below = points[points[:, 2] < centers[:, 2].median()]
    if len(below) < _LEAST_POINTS:
        return None
    if len(below) > _MAX_POINTS:
        below = below[torch.randperm(len(below), generator=generator)[:_MAX_POINTS]]
    triples = below[torch.randint(len(below), (_HYPOTHESES, 3), generator=generator)].double()
    rows = torch.cat([triples[..., :2], torch.ones_like(triples[..., :1])], dim=-1)
    usable = torch.linalg.det(rows).abs() > 1e-6
    hypotheses = torch.linalg.solve(rows[usable], triples[usable][..., 2]).float()
    hypotheses = hypotheses[hypotheses[:, :2].norm(dim=1) < _STEEPEST]
    if len(hypotheses) == 0:
        return None
    members = _members(below, hypotheses, tolerance)
    best = members[int(members.sum(dim=1).argmax())]
    for _ in range(2):
        if int(best.sum()) < _LEAST_POINTS:
            return None
        known = below[best].double()
        rows = torch.cat([known[:, :2], torch.ones_like(known[:, :1])], dim=1)
        coefficients = torch.linalg.lstsq(rows, known[:, 2:]).solution[:, 0].float()
        best = _members(below, coefficients[None], tolerance)[0]
    plane = Plane(coefficients, _members(points, coefficients[None], tolerance)[0])
    above = centers[:, 2] > plane.heights(centers[:, :2])
    if float(best.float().mean()) < _LEAST_SHARE or float(above.float().mean()) < _LEAST_ABOVE:
        return None
    return plane


def _members(
    points: Float[Tensor, "P 3"], planes: Float[Tensor, "H 3"], tolerance: float
) -> Bool[Tensor, "H P"]:
    heights = planes[:, :2] @ points[:, :2].T + planes[:, 2:]
    return (points[:, 2] - heights).abs() < tolerance
