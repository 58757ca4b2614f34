"""Random viewpoints of the demo's photos."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True)
class Viewpoint:
    """A pinhole camera in OpenCV's axes (x right, y down, z forward), square pixels, centred.

    Attributes:
        position: Of the camera, metres.
        camera_to_world: Rotation.
        focal: Focal length in pixels.
        width: Of the photo, pixels.
        height: Of the photo, pixels.
    """

    position: Float[np.ndarray, "3"]
    camera_to_world: Float[np.ndarray, "3 3"]
    focal: float
    width: int
    height: int

    @property
    def center(self) -> Float[np.ndarray, "2"]:
        """Principal point in pixels; the top left pixel's centre lies at (0.5, 0.5)."""
        return np.array([self.width / 2, self.height / 2])

    def project(
        self, points: Float[np.ndarray, "P 3"]
    ) -> tuple[Float[np.ndarray, "P 2"], Float[np.ndarray, " P"]]:
        """Pixels and depths (along the camera's axis) of points; pixels are undefined where depth <= 0."""
        local = (points - self.position) @ self.camera_to_world
        depth = local[:, 2]
        safe = np.where(np.abs(depth) > 1e-9, depth, 1e-9)
        return local[:, :2] / safe[:, None] * self.focal + self.center, depth

    def unproject(
        self, pixels: Float[np.ndarray, "P 2"], depth: Float[np.ndarray, " P"]
    ) -> Float[np.ndarray, "P 3"]:
        """World points at pixels and depths (along the camera's axis)."""
        rays = np.column_stack([(pixels - self.center) / self.focal, np.ones(len(pixels))])
        return (rays * depth[:, None]) @ self.camera_to_world.T + self.position


def looking_at(
    position: Float[np.ndarray, "3"], target: Float[np.ndarray, "3"], roll: float = 0.0
) -> Float[np.ndarray, "3 3"]:
    """Camera-to-world rotation towards a target with the horizon level but for a roll in degrees."""
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    turn = np.deg2rad(roll)
    x = np.cos(turn) * right + np.sin(turn) * down
    return np.stack([x, np.cross(forward, x), forward], axis=1)


def draw_viewpoint(share: float, long_side: int, rng: np.random.Generator) -> Viewpoint:
    """A random view of the landmark.

    Args:
        share: Place along the arc about the front, 0 (far left) to 1 (far right).
        long_side: Longer side of the photo in pixels.
        rng: Randomness of this photo.
    """
    angle = np.deg2rad(-92.0 + 184.0 * share)
    distance = rng.uniform(19.0, 36.0) - 5.0 * (np.abs(share - 0.5) > 0.38)
    raised = rng.uniform() < 0.18
    height = rng.uniform(5.0, 11.0) if raised else rng.uniform(1.5, 1.8)
    position = np.array([distance * np.sin(angle) + 1.0, -distance * np.cos(angle) - 1.0, height])
    portrait = rng.uniform() < 0.4
    short_side = 2 * round(long_side / (2 * (4 / 3 if rng.uniform() < 0.7 else 3 / 2)))
    width, height_px = (short_side, long_side) if portrait else (long_side, short_side)
    target = np.array(
        [rng.uniform(-1.5, 3.5), rng.uniform(-2.0, 0.5), rng.uniform(6.0, 8.6) + 0.9 * portrait]
    )
    # A photographer zooms so that most of the landmark (about 26 m wide, 22 m high) is in the picture.
    seen = rng.uniform(26.0, 36.0) if not portrait else rng.uniform(18.0, 24.0)
    focal = width * np.linalg.norm(target - position) / seen
    focal = float(np.clip(focal, 0.62 * long_side, 1.5 * long_side))
    rotation = looking_at(position, target, roll=rng.normal(0.0, 1.2))
    return Viewpoint(position, rotation, focal, width, height_px)
