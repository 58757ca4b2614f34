"""The ground where nothing is known of it: the plane that known ground lies in, continued around the cameras.

Photographers look up at a landmark, and of the paving at their feet few photos show any one place. What none or one
of them shows has no points, and a view that looks there sees through the scene to whatever lies behind.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float, UInt8
from scipy.spatial import KDTree
from torch import Tensor

from wildgs.priors.config import GroundConfig

_HYPOTHESES = 512
_STEEPEST = 0.15
"""Slope of a ground, at most: steeper planes are walls, roofs and flights of stairs."""
_LEAST_SHARE = 0.2
"""Of the points below the cameras, that lie in the plane: less is no ground but some level thing."""
_LEAST_ABOVE = 0.9
"""Of the cameras, that stand above it."""
_LEAST_POINTS = 50
_MAX_CELLS = 2_000_000
"""Places of the grid, at most: of a grid that would have more, only those around the cameras are looked at."""
_MAX_POINTS = 20_000  # in the search; more make no better plane and a table of 512 times as many numbers


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
    members = _members(points, plane[None], config.tolerance)[0]
    feet, known = centers[:, :2], points[members]
    places = _places_around(feet, config)
    distance = torch.from_numpy(KDTree(feet.numpy()).query(places.numpy())[0])
    gap, nearest = (torch.from_numpy(found) for found in KDTree(known[:, :2].numpy()).query(places.numpy()))
    chosen = ((distance < config.reach) & (gap > config.spacing)).nonzero()[:, 0]
    chosen = chosen[distance[chosen].argsort(stable=True)[: config.points]]
    places = places[chosen]
    return torch.cat([places, (_padded(places) @ plane)[:, None]], dim=1), colors[members][nearest[chosen]]


def _places_around(feet: Float[Tensor, "V 2"], config: GroundConfig) -> Float[Tensor, "G 2"]:
    """A grid of places, row by row, within reach of the cameras.

    Of cameras that stand so far apart that the whole grid is too large, only the cells around each are taken: a
    stray camera costs no more than any other.
    """
    low, high = feet.min(dim=0).values - config.reach, feet.max(dim=0).values + config.reach
    counts = [max(0, math.ceil((float(high[i]) - float(low[i])) / config.spacing)) for i in range(2)]
    if counts[0] * counts[1] <= _MAX_CELLS:
        x, y = (torch.arange(float(low[i]), float(high[i]), config.spacing) for i in range(2))
        return torch.cartesian_prod(x, y)
    reach = min(math.ceil(config.reach / config.spacing), math.isqrt(_MAX_CELLS // 4) // 2)
    around = torch.cartesian_prod(*[torch.arange(-reach, reach + 1)] * 2)
    most = max(1, _MAX_CELLS // len(around))
    own = ((feet - low).double() / config.spacing).floor().long().unique(dim=0)
    own = own[:: -(-len(own) // most)]
    cells = (own[:, None] + around).reshape(-1, 2).unique(dim=0)
    return (low + cells * config.spacing).to(feet.dtype)


def find_ground(
    points: Float[Tensor, "P 3"], centers: Float[Tensor, "V 3"], tolerance: float, generator: torch.Generator
) -> Float[Tensor, "3"] | None:
    """The level plane under the cameras in which most points lie (RANSAC, then least squares).

    Returns:
        a, b and c of ``z = a x + b y + c``; None where too few points lie in any one plane, or cameras stand below
        it.
    """
    below = points[points[:, 2] < centers[:, 2].median()]
    if len(below) < _LEAST_POINTS:
        return None
    if len(below) > _MAX_POINTS:
        below = below[torch.randperm(len(below), generator=generator)[:_MAX_POINTS]]
    triples = below[torch.randint(len(below), (_HYPOTHESES, 3), generator=generator)].double()
    rows = _padded(triples)
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
        plane = torch.linalg.lstsq(_padded(known), known[:, 2:]).solution[:, 0].float()
        best = _members(below, plane[None], tolerance)[0]
    above = centers[:, 2] > _padded(centers) @ plane
    if float(best.float().mean()) < _LEAST_SHARE or float(above.float().mean()) < _LEAST_ABOVE:
        return None
    return plane


def _padded(points: Float[Tensor, "*B C"]) -> Float[Tensor, "*B 3"]:
    """(x, y, 1) of points or places: times a plane's coefficients, its height there."""
    return torch.cat([points[..., :2], torch.ones_like(points[..., :1])], dim=-1)


def _members(
    points: Float[Tensor, "P 3"], planes: Float[Tensor, "H 3"], tolerance: float
) -> Bool[Tensor, "H P"]:
    """Which points lie in each plane."""
    return (points[:, 2] - planes @ _padded(points).T).abs() < tolerance
