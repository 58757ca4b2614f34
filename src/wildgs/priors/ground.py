"""Ground completion: continues the plane of the ground around the cameras.

Photos of a landmark rarely show the paving in front of the photographer. SfM cannot triangulate surfaces that fewer
than two photos show, so a novel view in that direction would see through the scene to the background.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, UInt8
from scipy.spatial import KDTree
from torch import Tensor

from wildgs.geometry.camera import Camera
from wildgs.priors.config import GroundConfig
from wildgs.priors.ground_plane import height_at, heights_above

_MAX_CELLS = 2_000_000
"""Maximum number of grid cells; in a larger grid, only cells around the cameras are considered."""
_MOST_DIVISIONS = 6
"""Number of times that a cell is divided into four at most."""
_NEAREST = 0.5
"""Depth, in units of a cell's side, below which a cell's image does not grow any further."""


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
        points = torch.cat([places, height_at(plane, places)[:, None]], dim=1)
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
        plane: The ground; see `wildgs.priors.ground_plane`.
        cameras: Cameras of the training photos, at the size of training.
        config: Number, spacing and extent of the new points.

    Returns:
        The new points; none without a plane.
    """
    if plane is None or config.points == 0 or len(cameras) == 0:
        return GroundPoints(points[:0], colors[:0], points[:0, 0])
    members = _members(points, plane, config.tolerance)
    feet, known = torch.stack([camera.position for camera in cameras])[:, :2], points[members]
    places = _places_around(feet, config)
    distance = torch.from_numpy(KDTree(feet.numpy()).query(places.numpy())[0])
    gap, nearest = (torch.from_numpy(found) for found in KDTree(known[:, :2].numpy()).query(places.numpy()))
    chosen = ((distance < config.reach) & (gap > config.spacing)).nonzero()[:, 0]
    most = math.ceil(config.points / 2) if config.most_pixels else config.points
    chosen = chosen[distance[chosen].argsort(stable=True)[:most]]
    places = torch.cat([places[chosen], height_at(plane, places[chosen])[:, None]], dim=1)
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


def _members(points: Float[Tensor, "P 3"], plane: Float[Tensor, "3"], tolerance: float) -> Bool[Tensor, " P"]:
    """Points close to a plane."""
    return heights_above(plane, points).abs() < tolerance
