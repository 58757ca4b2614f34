"""Keeps the ground flat: Gaussians near the ground plane that few photos show are moved onto it while training.

Not in the paper. The paving before the photographers is shown by few photos, at grazing angles, which leaves its
depth open. It sinks below the ground or hangs above it as haze, and is blurred because photos from elsewhere
disagree about it. Unlike a term of the loss, the move is not rescaled by Adam, whose steps have the same length for
a Gaussian that a photo shows once in a hundred steps.
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
THINNEST = 0.25
"""Thickness of a flat Gaussian up to which it is reduced, relative to its other two scales."""


@dataclass(frozen=True)
class _Ground:
    """The ground plane around the cameras.

    Attributes:
        plane: a, b and c of ``z = a x + b y + c``.
        highest: Largest height of Gaussians above the plane.
        deepest: Largest depth of Gaussians below it, where there is hardly ever anything real.
        corner: Smallest x and y of the map.
        cell: Side of a cell.
        around: Cells within `REACH` of a camera.
    """

    plane: Float[Tensor, "3"]
    highest: float
    deepest: float
    corner: Float[Tensor, "2"]
    cell: float
    around: Bool[Tensor, "X Y"]

    @staticmethod
    def of(method: Method, scene: Scene, height: float) -> _Ground | None:
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
        cell, feet = REACH / CELLS_IN_REACH, centers[:, :2]
        farthest = MOST_CELLS / 2 * cell - REACH
        middle = feet[(feet - feet.median(dim=0).values).norm(dim=1).argmin()]
        feet = feet[((feet - middle).abs() < farthest).all(dim=1)]
        corner = feet.min(dim=0).values - REACH
        counts = ((feet.max(dim=0).values + REACH - corner) / cell).ceil().long()
        places = torch.cartesian_prod(*(torch.arange(int(count)) for count in counts)).to(feet) + 0.5
        distance = torch.from_numpy(KDTree(feet.numpy()).query((corner + cell * places).numpy())[0])
        around = (distance < REACH).reshape(int(counts[0]), int(counts[1]))
        return _Ground(
            plane.to(device), height * eyes, DEEPEST * eyes, corner.to(device), cell, around.to(device)
        )

    def is_near(self, points: Float[Tensor, "N 3"]) -> Bool[Tensor, " N"]:
        """Points close to the plane and to a camera."""
        # A point that is not finite is compared, and hence left out, by its height.
        x, y = ((points[:, :2] - self.corner) / self.cell).floor().nan_to_num().unbind(1)
        columns, rows = self.around.shape
        inside = (x >= 0) & (x < columns) & (y >= 0) & (y < rows)
        around = self.around[x.clamp(0, columns - 1).long(), y.clamp(0, rows - 1).long()]
        heights = heights_above(self.plane, points)
        return inside & around & (heights < self.highest) & (heights > -self.deepest)


class FlatGround:
    """Moves Gaussians near the ground that few photos show onto its plane, and makes them flat."""

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
            self._ground = _Ground.of(method, scene, config.height)

    @property
    def is_used(self) -> bool:
        """Whether Gaussians are moved, for which photos have to be counted."""
        return self._ground is not None

    def update(self, step: int, taken: int) -> None:
        """Moves Gaussians after the `taken` steps up to `step`, if it is time."""
        gaussians = self._method.gaussians
        if self._ground is not None and gaussians.photos is not None and falls_on(step, taken, EVERY):
            share = 1 - (1 - self._config.rate) ** max(EVERY, taken)
            _flatten(gaussians, self._ground, self._config.photos, share)


@torch.no_grad()
def _flatten(gaussians: Gaussians, ground: _Ground, photos: int, share: float) -> None:
    """Moves Gaussians towards the ground plane, and reduces their scales across it.

    Args:
        gaussians: Gaussians with numbers of photos; changed in place.
        ground: The ground.
        photos: Number of photos from which a Gaussian is left alone.
        share: Share of the distance by which Gaussians of the fewest photos move.
    """
    assert gaussians.photos is not None
    rows = (ground.is_near(gaussians.means) & (gaussians.photos < photos)).nonzero()[:, 0]
    means, log_scales = gaussians.rows["means"], gaussians.rows["log_scales"]
    pull = share * rareness(gaussians.photos[rows], photos)
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
