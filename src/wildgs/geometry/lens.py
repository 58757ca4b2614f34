"""Cameras that look somewhere, with the lens of others: what trajectories are made of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64

from wildgs.geometry.camera import Camera

Vector = Float64[np.ndarray, "3"]
UP = np.array([0.0, 0.0, 1.0])
"""Away from the ground, in a scene's aligned frame."""


@dataclass(frozen=True)
class Lens:
    """What every camera of a trajectory shares.

    Attributes:
        focal: Focal length, relative to the picture's long side: the same lens on frames of any shape.
        width: Pixels.
        height: Pixels.
    """

    focal: float
    width: int
    height: int

    def camera(self, position: Vector, forward: Vector, up: Vector = UP) -> Camera:
        """A camera at a place, looking somewhere, upright.

        Args:
            position: World coordinates.
            forward: Viewing direction, of any length but 0.
            up: What is up in the picture; not along `forward`.
        """
        z_axis = unit(forward)
        x_axis = np.cross(z_axis, up)
        if np.linalg.norm(x_axis) < 1e-6:  # straight up or down: any level axis will do
            x_axis = np.cross(z_axis, np.array([0.0, 1.0, 0.0]))
        x_axis = unit(x_axis)
        return self.posed(np.stack([x_axis, np.cross(z_axis, x_axis), z_axis]), position)

    def posed(self, rotation: Float64[np.ndarray, "3 3"], position: Vector) -> Camera:
        """A camera with the rows x right, y down, z forward as its axes."""
        viewmat = np.eye(4)
        viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ position
        return Camera(torch.from_numpy(viewmat).float(), self.intrinsics(), self.width, self.height)

    def intrinsics(self) -> torch.Tensor:
        """K, with the centre in the middle of the picture."""
        focal = self.focal * max(self.width, self.height)
        return torch.tensor([[focal, 0.0, self.width / 2], [0.0, focal, self.height / 2], [0.0, 0.0, 1.0]])


def unit(vector: Vector) -> Vector:
    """The vector at length 1."""
    return vector / np.linalg.norm(vector)


def focal_of(camera: Camera) -> float:
    """Focal length of a camera, relative to the long side."""
    return float(camera.K[0, 0]) / max(camera.width, camera.height)


def usual_lens(cameras: Sequence[Camera], width: int, height: int) -> Lens:
    """The median focal length of cameras, on a frame of another size."""
    return Lens(float(np.median([focal_of(camera) for camera in cameras])), width, height)


def positions_of(cameras: Sequence[Camera]) -> Float64[np.ndarray, "V 3"]:
    """Centres of cameras."""
    return np.stack([camera.position.double().cpu().numpy() for camera in cameras])


def forwards_of(cameras: Sequence[Camera]) -> Float64[np.ndarray, "V 3"]:
    """Viewing directions of cameras."""
    return np.stack([camera.forward.double().cpu().numpy() for camera in cameras])


def focus(cameras: Sequence[Camera], centre: Vector, rounds: int = 10) -> Vector:
    """Where cameras look: the point nearest to their viewing axes, in the sense of least distances.

    Args:
        cameras: At least one.
        centre: The middle of what they see. It decides where the axes do not (all cameras side by side).
        rounds: Of reweighting, which makes single cameras that look elsewhere not count.
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
