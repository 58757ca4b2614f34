"""The plane of the ground: a level plane below the cameras on which many points lie, and hardly any beside it.

Photographers stand on the ground and hold their cameras at about the same height. A plane at a third of that height
below them is therefore a wall, a hedge or a flight of stairs, however many points are near it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

STEEPEST, STEP = 0.1, 0.0075
"""Largest slope of the ground, and steps in which slopes are tried."""
USUAL_SLOPE = 0.06
"""Slope at which a plane needs 1.6 times as clear a layer of points as a horizontal one. The direction upwards,
which cameras determine, is a few degrees wrong at times, and steeper planes are flights of stairs."""
HEIGHTS = np.geomspace(0.01, 4.0, 190)
"""Usual heights of cameras above the ground that are tried, in units of the aligned frame."""
THICKNESS, THICKEST = 0.07, 0.03
"""Largest distance of a point on the ground from its plane, relative to the height of the cameras above it, and in
units of the aligned frame."""
LOWEST_CAMERAS, USUAL_CAMERAS, LEAST_HEIGHT = 0.1, 0.3, 0.4
"""Two quantiles of the cameras' heights, and the first one relative to the second, at least. Most photos may be
from hills and windows."""
LEAST_BREADTH = 0.1
"""Standard deviation of the points on the ground across their main direction, at least, relative to that along it:
ledges of walls are level, too."""
LEAST_POINTS = 30
LEAST_CLEAR, PER_DOUBLING = 4.0, 0.4
"""Excess of the points on the plane over those in the layers above and below it, in standard deviations, of 300
points or fewer, and how much more it must be of twice as many, among which more layers are clear by chance. The
true ground of `gate` has 4.7 with 40 photos and 8 with 90, and 5.6 and 21 by stereo of 10 and 20; where `longchamp`
and `temple` have no level ground, the best plane has 2.8 to 3.5."""
CELL = (0.04, 0.04, 0.004)
"""Size of the cells of which one point each is kept, so that planes count by area: stairs have more points than
paving."""
MOST_POINTS = 6_000
"""Number of points that are searched at most."""


def ground_plane(
    sparse: Float[Tensor, "P 3"], surface: Callable[[], Float[Tensor, "Q 3"]], centers: Float[Tensor, "V 3"]
) -> Float[Tensor, "3"] | None:
    """Finds the ground by the points of SfM, or by further points where those do not show it.

    Where photos disagree about the depth of the ground, points from depth maps lie in several layers
    (`wildgs.priors.depth_points`), which lowers the plane by a tenth of a photographer's height on one scene.

    Args:
        sparse: Points of SfM.
        surface: Gives these and points from depth maps; called if it is needed.
        centers: Camera centres.

    Returns:
        See `find_ground`.
    """
    plane = find_ground(sparse, centers)
    if plane is None and len(points := surface()) > len(sparse):
        return find_ground(points, centers)
    return plane


def find_ground(points: Float[Tensor, "P 3"], centers: Float[Tensor, "V 3"]) -> Float[Tensor, "3"] | None:
    """Finds the level plane below the cameras that has the clearest layer of points.

    All slopes up to `STEEPEST` and all heights of the cameras are tried. A plane counts by the points within
    `THICKNESS`, less those in layers of the same size above and below. Walls have as many points in either.

    Args:
        points: Points in the aligned frame (+z up).
        centers: Camera centres.

    Returns:
        a, b and c of ``z = a x + b y + c``; None if there is no clear layer.
    """
    below = _below(points, centers)
    if len(below) < LEAST_POINTS:
        return None
    best = _clearest(below.numpy(), centers.double().numpy())
    least = LEAST_CLEAR + PER_DOUBLING * max(0.0, math.log2(len(below) / 300))
    plane = _fitted(best, below) if best.clear >= least else None
    return None if plane is None or not _is_stood_on(plane, centers.double()) else plane.float()


def clearness(points: Float[Tensor, "P 3"], centers: Float[Tensor, "V 3"]) -> float:
    """Excess of the clearest level layer over the layers above and below it, in standard deviations."""
    below = _below(points, centers)
    return _clearest(below.numpy(), centers.double().numpy()).clear if len(below) else 0.0


def heights_above(plane: Float[Tensor, "3"], points: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B"]:
    """Vertical distance of points from a plane of `find_ground`, negative below it."""
    return points[..., 2] - height_at(plane, points[..., :2])


def height_at(plane: Float[Tensor, "3"], places: Float[Tensor, "*B 2"]) -> Float[Tensor, "*B"]:
    """Height of a plane of `find_ground` at horizontal positions."""
    return places @ plane[:2] + plane[2]


@dataclass(frozen=True)
class _Layer:
    """Points between two parallel planes.

    Attributes:
        plane: a, b and c of the plane in the middle.
        thickness: Largest vertical distance of a point from it.
        clear: Excess over the layers above and below, in standard deviations, less for steep planes.
    """

    plane: tuple[float, float, float]
    thickness: float
    clear: float


def _below(points: Float[Tensor, "P 3"], centers: Float[Tensor, "V 3"]) -> Float64[Tensor, "Q 3"]:
    """Points below most cameras, thinned; none without cameras."""
    if not len(centers):
        return points[:0].double()
    below = _thinned(points[points[:, 2] < centers[:, 2].median()].double())
    if len(below) <= MOST_POINTS:
        return below
    return below[torch.randperm(len(below), generator=torch.Generator().manual_seed(0))[:MOST_POINTS]]


def _thinned(points: Float[Tensor, "P 3"]) -> Float[Tensor, "Q 3"]:
    """One point of each cell."""
    cells = (points / points.new_tensor(CELL)).floor().long()
    _, cell = cells.unique(dim=0, return_inverse=True)
    first = torch.full((len(points),), len(points))
    first.scatter_reduce_(0, cell, torch.arange(len(points)), "amin")
    return points[first[first < len(points)]]


def _slopes() -> Float64[np.ndarray, "S 2"]:
    """Slopes along x and y, in a disc."""
    steps = STEP * np.arange(-int(STEEPEST / STEP), int(STEEPEST / STEP) + 1)
    slopes = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
    return slopes[np.linalg.norm(slopes, axis=1) <= STEEPEST]


def _clearest(points: Float64[np.ndarray, "P 3"], centers: Float64[np.ndarray, "V 3"]) -> _Layer:
    """The layer of all slopes and heights that has the clearest excess of points."""
    slopes, thickness = _slopes(), (THICKNESS * HEIGHTS).clip(max=THICKEST)
    eyes = centers[:, 2] - slopes @ centers[:, :2].T
    planes = np.quantile(eyes, USUAL_CAMERAS, axis=1)[:, None] - HEIGHTS
    edges = planes[:, None] + np.array([-2, -1, 1, 2])[:, None] * thickness
    found = np.empty(edges.shape, np.int64)
    for slope, wanted, counts in zip(slopes, edges, found, strict=True):
        counts[:] = np.searchsorted(np.sort(points[:, 2] - points[:, :2] @ slope), wanted)
    inside = found[:, 2] - found[:, 1]
    beside = found[:, 3] - found[:, 0] - inside
    clear = (inside - beside) / np.sqrt(inside + beside + 1)
    clear *= np.exp(-np.square(slopes).sum(axis=1) / (2 * USUAL_SLOPE**2))[:, None]
    lowest = np.quantile(eyes, LOWEST_CAMERAS, axis=1)[:, None] - planes
    clear[(inside < LEAST_POINTS) | (lowest < LEAST_HEIGHT * HEIGHTS)] = 0
    slope, height = np.unravel_index(clear.argmax(), clear.shape)
    x, y = slopes[slope].tolist()
    return _Layer((x, y, float(planes[slope, height])), float(thickness[height]), float(clear[slope, height]))


def _fitted(layer: _Layer, points: Float[Tensor, "P 3"]) -> Float[Tensor, "3"] | None:
    """The plane that fits the points of a layer best (least squares); None if these are few or in a line."""
    plane, near = points.new_tensor(layer.plane), points
    for _ in range(2):
        near = points[heights_above(plane, points).abs() < layer.thickness]
        if len(near) < LEAST_POINTS:
            return None
        rows = torch.cat([near[:, :2], torch.ones_like(near[:, :1])], dim=1)
        plane = torch.linalg.lstsq(rows, near[:, 2:]).solution[:, 0]
    across, along = torch.linalg.eigvalsh(near[:, :2].T.cov()).clamp_min(0).sqrt()
    return plane if bool(across > LEAST_BREADTH * along) else None


def _is_stood_on(plane: Float[Tensor, "3"], centers: Float[Tensor, "V 3"]) -> bool:
    """Whether most cameras are at about the same height above a plane."""
    heights = heights_above(plane, centers)
    return bool(heights.quantile(LOWEST_CAMERAS) >= LEAST_HEIGHT * heights.quantile(USUAL_CAMERAS))
