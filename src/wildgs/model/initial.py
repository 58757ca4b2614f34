"""The initial Gaussians: on SfM points, on surfaces of depth maps, on the ground plane and in the sky."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from wildgs.errors import WildGSWarning
from wildgs.geometry.camera import Camera
from wildgs.model.config import InitialConfig, SkyConfig
from wildgs.model.gaussians import geometry_from_points
from wildgs.model.sky import COLOR as SKY_COLOR
from wildgs.model.sky import sky_points
from wildgs.priors.config import GroundConfig
from wildgs.priors.depth_points import depth_points
from wildgs.priors.ground import GroundPoints, ground_points
from wildgs.priors.ground_plane import ground_plane
from wildgs.scene import Scene

ColoredPoints = tuple[Float[Tensor, "_ 3"], UInt8[Tensor, "_ 3"]]
"""Positions in the aligned frame, and 8-bit colours."""

GROUND_WIDTH, GROUND_THICKNESS = 0.6, 0.1
"""Standard deviations along and across the ground, in units of the spacing, so that neighbours overlap."""
GROUND_OPACITY = 0.7


@dataclass(frozen=True)
class InitialGaussians:
    """Initial geometry and colours, from which a method is created.

    Attributes:
        rows: Geometry of all initial Gaussians: means, quats, log_scales, opacity_logits.
        colors: Their colours, RGB in [0, 1].
        points: The SfM points among them, in the aligned frame.
        point_colors: Colours of the SfM points, RGB in [0, 1].
        photos: Names of the training photos.
    """

    rows: dict[str, Tensor]
    colors: Float[Tensor, "N 3"]
    points: Float[Tensor, "P 3"]
    point_colors: Float[Tensor, "P 3"]
    photos: tuple[str, ...] = ()


@dataclass(frozen=True)
class InitialBudget:
    """Divides `max_gaussians` among the initial Gaussians.

    The sky gets at most a sixth, SfM points at most three quarters of the rest, depth points at most half of what
    then remains, and the ground at most half of what they leave. Densification uses the remainder.
    """

    max_gaussians: int

    def sky(self, wanted: int) -> int:
        """Number of sky Gaussians."""
        return min(wanted, self.max_gaussians // 6)

    def sfm(self, found: int, sky: int) -> int:
        """Number of Gaussians on SfM points; at least one."""
        return min(found, max(1, 3 * (self.max_gaussians - sky) // 4))

    def further(self, wanted: int, taken: int) -> int:
        """Number of depth points or ground points when `taken` Gaussians are placed already."""
        return min(wanted, max(0, self.max_gaussians - taken) // 2)


def initial_gaussians(
    scene: Scene, config: InitialConfig, max_gaussians: int, seed: int = 0
) -> InitialGaussians:
    """Creates all initial Gaussians of a scene.

    Args:
        scene: The scene with SfM points and depth maps of training photos.
        config: Initial Gaussians in addition to those on SfM points.
        max_gaussians: Upper bound on their total number, divided by `InitialBudget`.
        seed: Random seed.
    """
    budget = InitialBudget(max_gaussians)
    sky = replace(config.sky, points=budget.sky(config.sky.points))
    sparse = _thinned(scene, budget.sfm(len(scene.points), sky.points), seed)
    taken = sky.points + len(sparse[0])
    wanted = replace(config.depth_points, points=budget.further(config.depth_points.points, taken))
    dense = depth_points(scene, wanted, seed)
    taken += len(dense[0])
    wanted_ground = replace(config.ground, points=budget.further(config.ground.points, taken))
    points, colors = (torch.cat(both) for both in zip(sparse, dense, strict=True))
    cameras = [view.camera for view in scene.train_views]
    plane = _ground_below(cameras, sparse[0], points, wanted_ground)
    ground = ground_points(points, colors, plane, cameras, wanted_ground)
    names = [view.name for view in scene.train_views]
    positions = torch.stack([view.camera.position for view in scene.views]) if scene.views else None
    return initial_from_points(
        replace(config, sky=sky), *sparse, dense=dense, ground=ground, cameras=positions, photos=names
    )


def _ground_below(
    cameras: Sequence[Camera],
    sparse: Float[Tensor, "P 3"],
    surface: Float[Tensor, "Q 3"],
    config: GroundConfig,
) -> Float[Tensor, "3"] | None:
    """The plane on which `wildgs.engine.flat_ground` keeps the ground; None if there is or should be none."""
    if not (cameras and config.points):
        return None
    centers = torch.stack([camera.position for camera in cameras])
    return ground_plane(sparse, lambda: surface, centers)


def initial_from_points(
    config: InitialConfig,
    points: Float[Tensor, "P 3"],
    colors: UInt8[Tensor, "P 3"],
    *,
    dense: ColoredPoints | None = None,
    ground: GroundPoints | None = None,
    cameras: Float[Tensor, "V 3"] | None = None,
    photos: Sequence[str] = (),
) -> InitialGaussians:
    """Creates initial Gaussians from given points, and the sky.

    Args:
        config: Configuration of the sky.
        points: SfM points in the aligned frame.
        colors: Their colours.
        dense: Further points from depth maps.
        ground: Points that extend the ground plane.
        cameras: Positions of all photos' cameras, around which the sky is.
        photos: Names of the training photos.
    """
    surface, surface_colors = points, colors
    if dense is not None:
        surface, surface_colors = torch.cat([points, dense[0]]), torch.cat([colors, dense[1]])
    parts = [(geometry_from_points(surface), surface_colors.float() / 255)]
    if ground is not None:
        parts.append((ground_rows(ground.points, ground.spacing), ground.colors.float() / 255))
    if config.sky.points:
        parts.append((sky_rows(config.sky, points, cameras), torch.full((config.sky.points, 3), SKY_COLOR)))
    return InitialGaussians(
        rows={name: torch.cat([rows[name] for rows, _ in parts]) for name in parts[0][0]},
        colors=torch.cat([unit for _, unit in parts]),
        points=points,
        point_colors=colors.float() / 255,
        photos=tuple(photos),
    )


def ground_rows(points: Float[Tensor, "G 3"], spacing: Float[Tensor, " G"]) -> dict[str, Tensor]:
    """Geometry of the ground's Gaussians: thin horizontal discs, initially nearly opaque.

    Args:
        points: Their centres in the aligned frame.
        spacing: Distance of each one from its neighbours, world units.
    """
    count = len(points)
    scales = spacing[:, None] * torch.tensor([GROUND_WIDTH, GROUND_WIDTH, GROUND_THICKNESS])
    return {
        "means": points.float().clone(),
        "quats": torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        "log_scales": scales.log(),
        "opacity_logits": torch.full((count,), GROUND_OPACITY).logit(),
    }


def sky_rows(
    config: SkyConfig, points: Float[Tensor, "P 3"], cameras: Float[Tensor, "V 3"] | None = None
) -> dict[str, Tensor]:
    """Geometry of the sky's Gaussians: isotropic, as large as their spacing, around the scene's SfM points."""
    rows = geometry_from_points(sky_points(config, points, cameras))
    rows["opacity_logits"] = torch.full((config.points,), config.opacity).logit()
    return rows


def _thinned(scene: Scene, allowed: int, seed: int) -> ColoredPoints:
    """The scene's SfM points, or a random selection of `allowed` of them."""
    count = len(scene.points)
    if count <= allowed:
        return scene.points, scene.point_colors
    warnings.warn(
        f"the scene has {count:,} points; training starts from {allowed:,} of them (--max-gaussians)",
        WildGSWarning,
        stacklevel=4,
    )
    generator = torch.Generator().manual_seed(seed)
    chosen = torch.randperm(count, generator=generator)[:allowed].sort().values
    return scene.points[chosen], scene.point_colors[chosen]
