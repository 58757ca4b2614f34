"""The scene's own axes: up is +z, the ground's principal directions are x and y, the usual depth is 1.

COLMAP's frame is arbitrary in rotation and scale. The triplane (paper, section on 3D Wrapping) projects along
the world's axes, so the axes must lie along the scene's.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from wildgs.geometry.camera import Camera
from wildgs.scene.scene import Alignment

INLIER_SHARE = 0.9
"""Share of the points, nearest first, from which the principal directions are taken."""

LEVEL_TOLERANCE = 0.02
"""Sine of the roll with which people hold a camera level; rolls beyond it count less and less."""

PRIOR_WEIGHT = 0.01
"""Weight of the mean up vector against the horizontal axes (whose mean square cosine is up to 1/2)."""


def align_world(
    cameras: Sequence[Camera],
    points: Float[Tensor, "P 3"],
    view_depths: Sequence[float],
) -> Alignment:
    """Find the similarity that takes the input's frame to the aligned one.

    Args:
        cameras: All registered cameras in the input's frame.
        points: Sparse points in the input's frame; at least one.
        view_depths: For each view that sees any, the median depth of its own points, input units.

    Returns:
        A right-handed similarity. Signs follow the scene (the cameras' mean lies on the -y side, as one who
        faces north), so the same scene in another input frame comes out the same.
    """
    points = points.to(torch.float64)
    positions = torch.stack([camera.position.to(torch.float64) for camera in cameras])
    up = _estimate_up(torch.stack([camera.viewmat[:3, :3].to(torch.float64) for camera in cameras]))
    centre = points.median(dim=0).values
    rotation = _ground_axes(up, points - centre, positions - centre)
    # The median of each coordinate depends on the axes, so it is taken once more along the final ones.
    centre = (points @ rotation.T).median(dim=0).values
    scale = _unit_depth_scale(points, positions, view_depths)
    return Alignment(rotation=rotation, translation=-scale * centre, scale=scale)


def _estimate_up(rotations: Float[Tensor, "V 3 3"], iterations: int = 20) -> Float[Tensor, "3"]:
    """The direction away from the ground, from the cameras' axes.

    The mean of the pictures' up vectors leans as far as the photographers tilt their cameras (all of them
    upwards, under a tower). Their horizontal axes do not lean, so the direction most at right angles to them,
    by least absolute cosines, corrects the mean; where all photos face one way, it stays.
    """
    right = rotations[:, 0]
    prior = _robust_mean(-rotations[:, 1])
    up = prior
    for _ in range(iterations):
        weights = 1.0 / ((right @ up).abs() + LEVEL_TOLERANCE)
        spread = right.T @ (right * (weights / weights.sum())[:, None])
        up = torch.linalg.solve(spread + PRIOR_WEIGHT * torch.eye(3).to(right), prior)
        up = up / up.norm()
    return up


def _robust_mean(directions: Float[Tensor, "V 3"], iterations: int = 50) -> Float[Tensor, "3"]:
    """Geometric median of unit vectors (Weiszfeld): a few photos held sideways do not tilt the world."""
    mean = directions.mean(dim=0)
    for _ in range(iterations):
        weights = 1.0 / (directions - mean).norm(dim=-1).clamp_min(1e-6)
        mean = (weights[:, None] * directions).sum(dim=0) / weights.sum()
    length = float(mean.norm())
    if length < 1e-6:  # ups that cancel out: no direction is better than the first photo's
        return directions[0] / directions[0].norm()
    return mean / length


def _ground_axes(
    up: Float[Tensor, "3"],
    points: Float[Tensor, "P 3"],
    positions: Float[Tensor, "V 3"],
) -> Float[Tensor, "3 3"]:
    """Rows x, y, z of the rotation; `points` and `positions` relative to the scene's centre."""
    helper = torch.eye(3, dtype=torch.float64)[int(up.abs().argmin())]
    first = torch.linalg.cross(up, helper)
    first = first / first.norm()
    second = torch.linalg.cross(up, first)
    plane = torch.stack([first, second])

    ground = points @ plane.T
    radius = ground.norm(dim=-1)
    reach = radius.kthvalue(max(1, round(INLIER_SHARE * len(radius)))).values
    ground = ground[radius <= reach]
    ground = ground - ground.mean(dim=0)
    _, vectors = torch.linalg.eigh(ground.T @ ground)
    x_axis = vectors[:, 1] @ plane  # eigh sorts ascending: the last direction is the largest
    y_axis = torch.linalg.cross(up, x_axis)

    if _prefers_flip(y_axis, points, positions):
        x_axis, y_axis = -x_axis, -y_axis
    return torch.stack([x_axis, y_axis, up])


def _prefers_flip(
    y_axis: Float[Tensor, "3"], points: Float[Tensor, "P 3"], positions: Float[Tensor, "V 3"]
) -> bool:
    """Whether y must turn round so that the cameras lie on its negative side (for a ring, the points)."""
    camera_side = float((positions @ y_axis).mean())
    spread = float((positions @ y_axis).abs().mean())
    if abs(camera_side) > 1e-3 * max(spread, 1e-12):
        return camera_side > 0
    return float((points @ y_axis).mean()) < 0


def _unit_depth_scale(
    points: Float[Tensor, "P 3"], positions: Float[Tensor, "V 3"], view_depths: Sequence[float]
) -> float:
    """The factor that makes the median over views of their median depth 1."""
    usable = torch.tensor([depth for depth in view_depths if depth > 0], dtype=torch.float64)
    if len(usable) == 0:
        usable = (positions - points.median(dim=0).values).norm(dim=-1)
    depth = float(usable.quantile(0.5))
    return 1.0 / depth if depth > 0 else 1.0
