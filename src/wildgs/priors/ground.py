"""Ground completion: fits a plane to the ground points and continues it around the cameras.

Photos of a landmark rarely show the paving in front of the photographer. SfM cannot triangulate surfaces that fewer
than two photos show, so a novel view in that direction would see through the scene to the background.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, UInt8
from scipy.spatial import KDTree
from torch import Tensor

from wildgs.geometry.camera import Camera
from wildgs.priors.config import GroundConfig

_HYPOTHESES = 512
_STEEPEST = 0.15
"""Maximum slope of the ground; steeper planes are walls, roofs or flights of stairs."""
_LEAST_SHARE = 0.2
"""Minimum share of inliers among the points below the cameras; a plane with fewer is some other level surface."""
_LEAST_ABOVE = 0.9
"""Minimum share of the cameras above the plane."""
_LEAST_POINTS = 50
_NEAR_SHARE = 0.05
"""Tolerance of the refined plane, relative to the height of the lowest cameras above it. An error of the plane by
so much is one of the depth of the ground by as much."""
_MAX_CELLS = 2_000_000
"""Maximum number of grid cells; in a larger grid, only cells around the cameras are considered."""
_MOST_DIVISIONS = 6
"""Number of times that a cell is divided into four at most."""
_NEAREST = 0.5
"""Depth, in units of a cell's side, below which a cell's image does not grow any further."""
_MAX_POINTS = 20_000  # for RANSAC; more do not improve the plane, and memory is 512 times as many numbers


@dataclass(frozen=True)
class GroundPoints:
    """Points on the ground.

    Attributes:
        points: Positions in the aligned frame.
        colors: Colours.
        spacing: Distance of each point from its neighbours.
    """

    points: Float[Tensor, "G 3"]
    colors: UInt8[Tensor, "G 3"]
    spacing: Float[Tensor, " G"]

    def __len__(self) -> int:
        """Number of points."""
        return len(self.points)

    def take(self, chosen: Tensor) -> GroundPoints:
        """The chosen points."""
        return GroundPoints(self.points[chosen], self.colors[chosen], self.spacing[chosen])

    def joined(self, further: GroundPoints) -> GroundPoints:
        """These points and further ones."""
        return GroundPoints(
            torch.cat([self.points, further.points]),
            torch.cat([self.colors, further.colors]),
            torch.cat([self.spacing, further.spacing]),
        )

    def quartered(self, plane: Float[Tensor, "3"]) -> GroundPoints:
        """Four points in the cell of each one, at half the distance from each other."""
        corners = torch.tensor([[-1, -1], [-1, 1], [1, -1], [1, 1]]).to(self.points)
        places = (self.points[:, None, :2] + self.spacing[:, None, None] / 4 * corners).reshape(-1, 2)
        points = torch.cat([places, (_padded(places) @ plane)[:, None]], dim=1)
        return GroundPoints(
            points, self.colors.repeat_interleave(4, dim=0), (self.spacing / 2).repeat_interleave(4)
        )


def ground_points(
    points: Float[Tensor, "P 3"],
    colors: UInt8[Tensor, "P 3"],
    plane: Float[Tensor, "3"] | None,
    cameras: Sequence[Camera],
    config: GroundConfig,
) -> GroundPoints:
    """Generates points that continue the ground plane where the scene has no points.

    Args:
        points: Points of the scene in the aligned frame (+z up).
        colors: Colours of the points; new points take the colour of the nearest ground point.
        plane: The ground; see `find_ground`.
        cameras: Cameras of the training photos, at the size of training.
        config: Number, spacing and extent of the new points.

    Returns:
        The new points; none without a plane.
    """
    if plane is None or config.points == 0 or len(cameras) == 0:
        return GroundPoints(points[:0], colors[:0], points[:0, 0])
    members = _members(points, plane[None], config.tolerance)[0]
    feet, known = torch.stack([camera.position for camera in cameras])[:, :2], points[members]
    places = _places_around(feet, config)
    distance = torch.from_numpy(KDTree(feet.numpy()).query(places.numpy())[0])
    gap, nearest = (torch.from_numpy(found) for found in KDTree(known[:, :2].numpy()).query(places.numpy()))
    chosen = ((distance < config.reach) & (gap > config.spacing)).nonzero()[:, 0]
    most = math.ceil(config.points / 2) if config.most_pixels else config.points
    chosen = chosen[distance[chosen].argsort(stable=True)[:most]]
    places = torch.cat([places[chosen], (_padded(places[chosen]) @ plane)[:, None]], dim=1)
    found = GroundPoints(
        places, colors[members][nearest[chosen]], torch.full((len(places),), config.spacing).to(places)
    )
    return _denser(found, plane, cameras, config) if config.most_pixels else found


def _denser(
    ground: GroundPoints, plane: Float[Tensor, "3"], cameras: Sequence[Camera], config: GroundConfig
) -> GroundPoints:
    """Replaces points whose neighbours are farther away than `most_pixels` in a photo by four, up to `points`."""
    pixels = _largest_in_photos(ground.points, ground.spacing, cameras)
    for _ in range(_MOST_DIVISIONS):
        large = pixels.argsort(descending=True, stable=True)[: max(0, config.points - len(pixels)) // 3]
        large = large[pixels[large] > config.most_pixels]
        if not len(large):
            break
        rest = torch.ones_like(pixels, dtype=torch.bool)
        rest[large] = False
        finer = ground.take(large).quartered(plane)
        pixels = torch.cat([pixels[rest], _largest_in_photos(finer.points, finer.spacing, cameras)])
        ground = ground.take(rest).joined(finer)
    return ground


def _largest_in_photos(
    points: Float[Tensor, "G 3"], lengths: Float[Tensor, " G"], cameras: Sequence[Camera]
) -> Float[Tensor, " G"]:
    """The largest image of a length at each point in the photos that show the point, pixels; 0 where none does."""
    largest = torch.zeros_like(lengths)
    for camera in cameras:
        places, depths = camera.project(points)
        size = places.new_tensor([camera.width, camera.height])
        pixels = camera.K[0, 0] * lengths / depths.clamp_min(_NEAREST * lengths)
        margin = pixels[:, None] / 2
        shown = (depths > 0) & (places > -margin).all(dim=1) & (places < size + margin).all(dim=1)
        largest = torch.where(shown, torch.maximum(largest, pixels), largest)
    return largest


def _places_around(feet: Float[Tensor, "V 2"], config: GroundConfig) -> Float[Tensor, "G 2"]:
    """Grid positions within reach of the cameras, row by row.

    If the cameras are so far apart that the whole grid would be too large, only cells around each camera are
    returned, so that a stray camera does not increase the cost.
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


def ground_plane(
    sparse: Float[Tensor, "P 3"],
    surface: Callable[[], Float[Tensor, "Q 3"]],
    centers: Float[Tensor, "V 3"],
    tolerance: float,
) -> Float[Tensor, "3"] | None:
    """Finds the ground by the points of SfM, or by further points where those are too few.

    Where photos disagree about the depth of the ground, points from depth maps lie in several layers
    (`wildgs.priors.depth_points`), which lowers the plane by a tenth of a photographer's height on one scene.

    Args:
        sparse: Points of SfM.
        surface: Gives these and points from depth maps; called if it is needed.
        centers: Camera centres.
        tolerance: See `GroundConfig`.

    Returns:
        See `find_ground`.
    """
    plane = find_ground(sparse, centers, tolerance, torch.Generator().manual_seed(0))
    if plane is None and len(points := surface()) > len(sparse):
        return find_ground(points, centers, tolerance, torch.Generator().manual_seed(0))
    return plane


def find_ground(
    points: Float[Tensor, "P 3"], centers: Float[Tensor, "V 3"], tolerance: float, generator: torch.Generator
) -> Float[Tensor, "3"] | None:
    """Finds the level plane below the cameras with the most inliers, and refines it (see `_refined`).

    Returns:
        a, b and c of ``z = a x + b y + c``; None if every plane has too few inliers, or cameras lie below it.
    """
    below = points[points[:, 2] < centers[:, 2].median()]
    if len(below) < _LEAST_POINTS:
        return None
    if len(below) > _MAX_POINTS:
        below = below[torch.randperm(len(below), generator=generator)[:_MAX_POINTS]]
    plane = _level_plane(below, tolerance, generator)
    if plane is None:
        return None
    best = _members(below, plane[None], tolerance)[0]
    above = centers[:, 2] > _padded(centers) @ plane
    if float(best.float().mean()) < _LEAST_SHARE or float(above.float().mean()) < _LEAST_ABOVE:
        return None
    return _refined(below, centers, plane, tolerance, generator)


def _refined(
    points: Float[Tensor, "P 3"],
    centers: Float[Tensor, "V 3"],
    plane: Float[Tensor, "3"],
    tolerance: float,
    generator: torch.Generator,
) -> Float[Tensor, "3"]:
    """The plane with the most inliers near a coarse one, within a tolerance that fits the cameras' height.

    Steps, kerbs and plinths within the coarse tolerance raise and tilt the plane. At eye height, an error of a
    tenth of the height already moves the ground at the feet of a photographer by a tenth of its distance.
    """
    heights = centers[:, 2] - _padded(centers) @ plane
    narrow = min(tolerance, _NEAR_SHARE * float(heights.quantile(0.1)))
    near = _lowest(points[_members(points, plane[None], 2 * tolerance)[0]], 2 * tolerance)
    finer = _level_plane(near, narrow, generator) if narrow > 0 else None
    if finer is None or not bool((centers[:, 2] > _padded(centers) @ finer)[heights > 0].all()):
        return plane
    return finer


def _lowest(points: Float[Tensor, "P 3"], cell: float) -> Float[Tensor, "Q 3"]:
    """The lowest point of each cell of a horizontal grid, so that a plane counts by its area."""
    index = (points[:, :2] / cell).floor().long()
    _, member = index.unique(dim=0, return_inverse=True)
    order = points[:, 2].argsort(stable=True)
    first = torch.full((int(member.max()) + 1,), len(points), dtype=torch.int64) if len(points) else member
    first.scatter_reduce_(0, member[order], torch.arange(len(points)), "amin")
    return points[order[first]]


def _level_plane(
    points: Float[Tensor, "P 3"], tolerance: float, generator: torch.Generator
) -> Float[Tensor, "3"] | None:
    """The level plane with the most inliers (RANSAC, then least squares); None if it has too few."""
    triples = points[torch.randint(len(points), (_HYPOTHESES, 3), generator=generator)].double()
    rows = _padded(triples)
    usable = torch.linalg.det(rows).abs() > 1e-6
    hypotheses = torch.linalg.solve(rows[usable], triples[usable][..., 2]).float()
    hypotheses = hypotheses[hypotheses[:, :2].norm(dim=1) < _STEEPEST]
    if len(hypotheses) == 0:
        return None
    members = _members(points, hypotheses, tolerance)
    best, plane = members[int(members.sum(dim=1).argmax())], None
    for _ in range(2):
        if int(best.sum()) < _LEAST_POINTS:
            return None
        known = points[best].double()
        plane = torch.linalg.lstsq(_padded(known), known[:, 2:]).solution[:, 0].float()
        best = _members(points, plane[None], tolerance)[0]
    return plane


def heights_above(plane: Float[Tensor, "3"], points: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B"]:
    """Vertical distance of points from a plane of `find_ground`, negative below it."""
    return points[..., 2] - _padded(points) @ plane


def _padded(points: Float[Tensor, "*B C"]) -> Float[Tensor, "*B 3"]:
    """(x, y, 1) of points; the product with a plane's coefficients is its height at that position."""
    return torch.cat([points[..., :2], torch.ones_like(points[..., :1])], dim=-1)


def _members(
    points: Float[Tensor, "P 3"], planes: Float[Tensor, "H 3"], tolerance: float
) -> Bool[Tensor, "H P"]:
    """Inliers of each plane."""
    return (points[:, 2] - planes @ _padded(points).T).abs() < tolerance
