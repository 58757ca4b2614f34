"""Keeps the ground flat: Gaussians near the ground plane are moved onto it while training.

Not in the paper. Photographers see paving at grazing angles, which leaves its depth open. It sinks below the
ground or hangs above it as haze, and is blurred because photos from elsewhere disagree about it. Unlike a term of
the loss, the move is not rescaled by Adam, whose steps have the same length for a Gaussian that a photo shows once
in a hundred steps.

Gaussians that few photos show are moved wherever they are near the plane. All others are moved only where sparse
points are on the plane, since steps and kerbs that many photos show are right already.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from scipy.spatial import KDTree
from torch import Tensor

from wildgs.engine.config import FlatGroundConfig
from wildgs.engine.schedule import falls_on
from wildgs.geometry.camera import quats_to_rotations
from wildgs.model.dropout import rareness
from wildgs.model.gaussians import Gaussians
from wildgs.model.method import Method
from wildgs.priors.depth_points import depth_points
from wildgs.priors.ground_plane import ground_plane, heights_above
from wildgs.scene import Scene

EVERY = 10
"""Steps between moves, each of which is as large as those of so many steps."""
REACH = 1.5
"""Horizontal distance from a camera up to which the ground is flattened, in units of the aligned frame."""
CELLS_IN_REACH, MOST_CELLS = 12, 1000
"""Cells of the map of the surroundings: within `REACH`, and at most along each side. Cameras
beyond it, such as one with a wrong pose, are left out."""
LOWEST_CAMERAS = 0.25
"""Quantile of the cameras' heights above the plane by which distances from it are measured."""
DEEPEST = 1.0
"""Largest depth below the plane of Gaussians that are moved, relative to that height."""
HIGHEST_EYES = 0.12
"""Cameras count as at most this high, in median depths. From a drone, a quarter of their height is houses."""
NEAREST, ON_PLANE = 3, 0.08
"""Number of the sparse points below the eyes that are nearest to a place, most of which have to be on the plane for
all Gaussians there to be moved, and how far from it they may be, relative to the same height. A step has 0.09."""
LEVEL_PULL = 0.2
"""How far a Gaussian that many photos show is moved there, relative to one that few photos show. Squares are not
exactly level, and photos that show them well should have their way."""
FINE = 0.25
"""Side of the cells of the map of such places, relative to the same height."""
THINNEST = 0.25
"""Thickness of a flat Gaussian up to which it is reduced, relative to its other two scales."""


@dataclass(frozen=True)
class _Map:
    """Cells of the plane, some of which are marked.

    Attributes:
        corner: Smallest x and y.
        cell: Side of a cell.
        marked: The marked cells.
    """

    corner: Float[Tensor, "2"]
    cell: float
    marked: Bool[Tensor, "X Y"]

    def has(self, points: Float[Tensor, "N 3"]) -> Bool[Tensor, " N"]:
        """Whether points are above or below a marked cell."""
        # A point that is not finite is in the first cell.
        x, y = ((points[:, :2] - self.corner) / self.cell).floor().nan_to_num().unbind(1)
        columns, rows = self.marked.shape
        inside = (x >= 0) & (x < columns) & (y >= 0) & (y < rows)
        return inside & self.marked[x.clamp(0, columns - 1).long(), y.clamp(0, rows - 1).long()]

    def to(self, device: torch.device) -> _Map:
        """The map on a device."""
        return _Map(self.corner.to(device), self.cell, self.marked.to(device))


@dataclass(frozen=True)
class _Ground:
    """The ground plane around the cameras.

    Attributes:
        plane: a, b and c of ``z = a x + b y + c``.
        highest: Largest height of Gaussians above the plane.
        deepest: Largest depth of Gaussians below it, where there is hardly ever anything real.
        around: Cells within `REACH` of a camera.
        level: Cells whose nearest sparse points are on the plane; None if this is not asked for.
    """

    plane: Float[Tensor, "3"]
    highest: float
    deepest: float
    around: _Map
    level: _Map | None

    @staticmethod
    def of(method: Method, scene: Scene, config: FlatGroundConfig) -> _Ground | None:
        """Finds the ground of a scene as for initial Gaussians; None without a level one below the cameras."""
        initial, device = method.initial(method.config), method.gaussians.means.device
        centers = torch.stack([view.camera.position for view in scene.train_views])

        def surface() -> Float[Tensor, "P 3"]:
            return torch.cat([scene.points, depth_points(scene, initial.depth_points)[0]])

        plane = ground_plane(scene.points, surface, centers)
        if plane is None:
            return None
        above = heights_above(plane, centers)
        eyes = min(HIGHEST_EYES, float(above[above > 0].quantile(LOWEST_CAMERAS)))
        around = _around(centers[:, :2])
        level = _level(scene.points, plane, eyes, around).to(device) if config.level else None
        return _Ground(plane.to(device), config.height * eyes, DEEPEST * eyes, around.to(device), level)

    def is_near(self, points: Float[Tensor, "N 3"]) -> Bool[Tensor, " N"]:
        """Points close to the plane and to a camera."""
        heights = heights_above(self.plane, points)  # those of points that are not finite are not close
        return self.around.has(points) & (heights < self.highest) & (heights > -self.deepest)


def _around(feet: Float[Tensor, "V 2"]) -> _Map:
    """Cells within `REACH` of a camera."""
    cell = REACH / CELLS_IN_REACH
    farthest = MOST_CELLS / 2 * cell - REACH
    middle = feet[(feet - feet.median(dim=0).values).norm(dim=1).argmin()]
    feet = feet[((feet - middle).abs() < farthest).all(dim=1)]
    corner = feet.min(dim=0).values - REACH
    places, shape = _centres(corner, feet.max(dim=0).values + REACH, cell)
    distance = torch.from_numpy(KDTree(feet.numpy()).query(places.numpy())[0])
    return _Map(corner, cell, (distance < REACH).reshape(shape))


def _level(points: Float[Tensor, "P 3"], plane: Float[Tensor, "3"], eyes: float, around: _Map) -> _Map:
    """Cells most of whose nearest sparse points up to the height of the eyes are on the plane."""
    extent = around.cell * torch.tensor(around.marked.shape)
    cell = max(FINE * eyes, float(extent.max()) / MOST_CELLS)
    places, shape = _centres(around.corner, around.corner + extent, cell)
    heights = heights_above(plane, points) / eyes
    low = heights.abs() < 1
    if int(low.sum()) < NEAREST:
        return _Map(around.corner, cell, torch.zeros(shape, dtype=torch.bool))
    nearest = torch.from_numpy(KDTree(points[low, :2].numpy()).query(places.numpy(), k=NEAREST)[1])
    on_plane = heights[low].abs() < ON_PLANE
    return _Map(around.corner, cell, (2 * on_plane[nearest].sum(dim=1) > NEAREST).reshape(shape))


def _centres(
    low: Float[Tensor, "2"], high: Float[Tensor, "2"], cell: float
) -> tuple[Float[Tensor, "C 2"], tuple[int, int]]:
    """Centres of the cells between two corners, and their number along each side."""
    columns, rows = (int(count) for count in ((high - low) / cell).ceil().clamp_min(1))
    cells = torch.cartesian_prod(torch.arange(columns), torch.arange(rows))
    return low + cell * (cells + 0.5), (columns, rows)


class FlatGround:
    """Moves Gaussians near the ground onto its plane, and makes them flat."""

    def __init__(self, method: Method, scene: Scene, config: FlatGroundConfig) -> None:
        """Finds the ground.

        Args:
            method: The method; it reads the numbers of photos in `Gaussians.photos`.
            scene: The scene, of which sparse points and cameras of training photos are used.
            config: Options.
        """
        self._method, self._config = method, config
        self._ground: _Ground | None = None
        if method.flattens_ground and config.rate > 0 and scene.train_views:
            self._ground = _Ground.of(method, scene, config)

    @property
    def is_used(self) -> bool:
        """Whether Gaussians are moved, for which photos have to be counted."""
        return self._ground is not None

    def update(self, step: int, taken: int) -> None:
        """Moves Gaussians after the `taken` steps up to `step`, if it is time."""
        if self._ground is not None and falls_on(step, taken, EVERY):
            share = 1 - (1 - self._config.rate) ** max(EVERY, taken)
            _flatten(self._method.gaussians, self._ground, self._config.photos, share)


def _pulls(gaussians: Gaussians, ground: _Ground, photos: int) -> Float[Tensor, " N"]:
    """How far Gaussians near the ground are moved, relative to those of the fewest photos."""
    counted = gaussians.photos  # None in the first steps
    pulls = torch.zeros_like(gaussians.means[:, 2]) if counted is None else rareness(counted, photos)
    if ground.level is not None:
        pulls = torch.maximum(pulls, LEVEL_PULL * ground.level.has(gaussians.means))
    return pulls


@torch.no_grad()
def _flatten(gaussians: Gaussians, ground: _Ground, photos: int, share: float) -> None:
    """Moves Gaussians towards the ground plane, and reduces their scales across it.

    Args:
        gaussians: Gaussians, with numbers of photos once these are known; changed in place.
        ground: The ground.
        photos: Number of photos from which a Gaussian is left alone where the ground is not known to be level.
        share: Share of the distance by which Gaussians of the fewest photos move.
    """
    pulls = _pulls(gaussians, ground, photos)
    rows = (ground.is_near(gaussians.means) & (pulls > 0)).nonzero()[:, 0]
    means, log_scales = gaussians.rows["means"], gaussians.rows["log_scales"]
    pull = share * pulls[rows]
    heights = heights_above(ground.plane, means[rows])
    means[rows, 2] -= pull * heights
    upwards = torch.nn.functional.normalize(torch.cat([-ground.plane[:2], ground.plane.new_ones(1)]), dim=0)
    axes = quats_to_rotations(gaussians.rows["quats"][rows])
    thin = (upwards @ axes).abs().argmax(dim=1, keepdim=True)
    scales = log_scales[rows]
    thickness = scales.gather(1, thin)[:, 0]
    wide = scales.scatter(1, thin, -torch.inf).logsumexp(dim=1)  # twice the mean of the other two
    excess = (thickness - wide - math.log(THINNEST / 2)).clamp_min(0)
    log_scales[rows, thin[:, 0]] = thickness - pull * excess
