"""Look-at cameras with the intrinsics of a collection: the building blocks of trajectories."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64

from wildgs.geometry.camera import Camera

Vector = Float64[np.ndarray, "3"]
UP = np.array([0.0, 0.0, 1.0])
"""Up direction in the aligned frame of a scene."""


@dataclass(frozen=True)
class Lens:
    """Shared intrinsics of a trajectory; `focal` is relative to the longer side, sizes are in pixels."""

    focal: float
    width: int
    height: int

    def camera(self, position: Vector, forward: Vector, up: Vector = UP) -> Camera:
        """An upright camera at a position, looking along `forward` (of any length), all in world coordinates."""
        z_axis = unit(forward)
        x_axis = np.cross(z_axis, up)
        if np.linalg.norm(x_axis) < 1e-6:  # looking straight up or down: the horizontal axis is arbitrary
            x_axis = np.cross(z_axis, np.array([0.0, 1.0, 0.0]))
        x_axis = unit(x_axis)
        return self.posed(np.stack([x_axis, np.cross(z_axis, x_axis), z_axis]), position)

    def posed(self, rotation: Float64[np.ndarray, "3 3"], position: Vector) -> Camera:
        """A camera whose axes (x right, y down, z forward) are the rows of `rotation`."""
        viewmat = np.eye(4)
        viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ position
        return Camera(torch.from_numpy(viewmat).float(), self.intrinsics(), self.width, self.height)

    def intrinsics(self) -> torch.Tensor:
        """K in pixels, with the principal point at the image centre."""
        focal = self.focal * max(self.width, self.height)
        return torch.tensor([[focal, 0.0, self.width / 2], [0.0, focal, self.height / 2], [0.0, 0.0, 1.0]])


def unit(vector: Vector) -> Vector:
    """Normalised vector."""
    return vector / np.linalg.norm(vector)


def focal_of(camera: Camera) -> float:
    """Focal length of a camera relative to its longer side."""
    return float(camera.K[0, 0]) / max(camera.width, camera.height)


def usual_lens(cameras: Sequence[Camera], width: int, height: int) -> Lens:
    """Lens of the median focal length of cameras, for another image size."""
    return Lens(float(np.median([focal_of(camera) for camera in cameras])), width, height)


def positions_of(cameras: Sequence[Camera]) -> Float64[np.ndarray, "V 3"]:
    """Camera centres in world coordinates."""
    return np.stack([camera.position.double().cpu().numpy() for camera in cameras])


def forwards_of(cameras: Sequence[Camera]) -> Float64[np.ndarray, "V 3"]:
    """Viewing directions of cameras in world coordinates."""
    return np.stack([camera.forward.double().cpu().numpy() for camera in cameras])


def focus(cameras: Sequence[Camera], centre: Vector, rounds: int = 10) -> Vector:
    """The point nearest to the viewing axes of all cameras, by iteratively reweighted least squares.

    `centre` is a weak prior that resolves ambiguity (parallel cameras); reweighting suppresses cameras that look
    elsewhere.
    """
    positions, forwards = positions_of(cameras), forwards_of(cameras)
    across = np.eye(3) - forwards[:, :, None] * forwards[:, None, :]
    prior = 0.02 * len(cameras)
    weights = np.ones(len(cameras))
    point = centre
    for _ in range(rounds):
        left = (across * weights[:, None, None]).sum(axis=0) + prior * np.eye(3)
        right = (across @ positions[:, :, None] * weights[:, None, None]).sum(axis=0)[:, 0] + prior * centre
        point = np.linalg.solve(left, right)
        distance = np.linalg.norm(across @ (point - positions)[:, :, None], axis=1)[:, 0]
        weights = 1 / (1 + distance / max(float(np.median(distance)), 1e-6))
    return point
