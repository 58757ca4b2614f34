"""The aligned frame: up is +z, the principal directions of the ground are x and y, the median depth is 1.

COLMAP's frame has an arbitrary rotation and scale, but the triplane (paper, section on 3D Wrapping) projects along
the axes, which therefore should be those of the scene.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from wildgs.geometry.camera import Camera
from wildgs.scene.scene import Alignment

INLIER_SHARE = 0.9
"""Fraction of the points, nearest first, from which the principal directions are computed."""

LEVEL_TOLERANCE = 0.02
"""Sine of the typical roll of a hand-held camera; larger rolls have decreasing weight."""

PRIOR_WEIGHT = 0.01
"""Weight of the mean up vector against the horizontal axes (whose mean square cosine is up to 1/2)."""


def align_world(
    cameras: Sequence[Camera],
    points: Float[Tensor, "P 3"],
    view_depths: Sequence[float],
) -> Alignment:
    """Computes the similarity transform from the input's frame to the aligned frame.

    Args:
        cameras: All registered cameras in the input's frame.
        points: Sparse points in the input's frame; at least one.
        view_depths: Median depth of the observed points of each view that has any, in input units.

    Returns:
        A right-handed similarity. Signs of the axes are determined by the scene (the mean of the cameras is on the
        -y side), so that the result does not depend on the input's frame.
    """
    points = points.to(torch.float64)
    positions = torch.stack([camera.position.to(torch.float64) for camera in cameras])
    up = _estimate_up(torch.stack([camera.viewmat[:3, :3].to(torch.float64) for camera in cameras]))
    centre = points.median(dim=0).values
    rotation = _ground_axes(up, points - centre, positions - centre)
    # The coordinatewise median depends on the axes, so it is computed again for the final ones.
    centre = (points @ rotation.T).median(dim=0).values
    scale = _unit_depth_scale(points, positions, view_depths)
    return Alignment(rotation=rotation, translation=-scale * centre, scale=scale)


def _estimate_up(rotations: Float[Tensor, "V 3 3"], iterations: int = 20) -> Float[Tensor, "3"]:
    """Estimates the up direction from the cameras' axes.

    The mean of the cameras' up vectors is biased if photographers tilt their cameras (upwards, below a tower), but
    their horizontal axes are not. The mean is corrected to the direction that is most perpendicular to these axes,
    by least absolute cosines. If all photos have the same viewing direction, the mean is kept.
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
    """Geometric median of unit vectors (Weiszfeld), robust against a few rotated photos."""
    mean = directions.mean(dim=0)
    for _ in range(iterations):
        weights = 1.0 / (directions - mean).norm(dim=-1).clamp_min(1e-6)
        mean = (weights[:, None] * directions).sum(dim=0) / weights.sum()
    length = float(mean.norm())
    if length < 1e-6:  # the directions cancel out
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
    """Whether y must be negated so that the cameras (of a ring: the points) are on its negative side."""
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
