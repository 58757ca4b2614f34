"""Conversion between viser's cameras (position, quaternion, vertical field of view) and `Camera`."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from wildgs.geometry.camera import Camera


@dataclass(frozen=True)
class Pose:
    """A camera in viser's representation, with OpenCV axes.

    Attributes:
        wxyz: Camera-to-world rotation.
        position: Camera centre, world units.
        fov: Vertical field of view, radians.
        aspect: Aspect ratio, width / height.
    """

    wxyz: Float[np.ndarray, " 4"]
    position: Float[np.ndarray, " 3"]
    fov: float
    aspect: float


def pose_of(camera: Camera) -> Pose:
    """Converts a camera to viser's, whose principal point is always the centre of the image."""
    camera = camera.centered()
    rotation = camera.viewmat[:3, :3].T.double().cpu().numpy()
    xyzw = Rotation.from_matrix(rotation).as_quat()
    return Pose(
        wxyz=xyzw[[3, 0, 1, 2]],
        position=camera.position.double().cpu().numpy(),
        fov=2 * math.atan(camera.height / (2 * float(camera.K[1, 1]))),
        aspect=camera.width / camera.height,
    )


def camera_of(camera: Any, height: int, aspect: float | None = None) -> Camera:
    """Converts the camera of a client (`viser.CameraHandle`) or a `Pose`.

    Args:
        camera: The camera.
        height: Height of the image in pixels.
        aspect: Aspect ratio, width / height; None keeps the camera's.
    """
    width = max(1, round(height * (aspect or camera.aspect)))
    w, x, y, z = (float(value) for value in camera.wxyz)
    rotation = Rotation.from_quat([x, y, z, w]).as_matrix().T
    viewmat = np.eye(4)
    viewmat[:3, :3] = rotation
    viewmat[:3, 3] = -rotation @ np.asarray(camera.position, dtype=np.float64)
    focal = height / (2 * math.tan(camera.fov / 2))
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], dtype=torch.float32)
    return Camera(torch.from_numpy(viewmat).float(), K, width, height)


def fov_that_holds(pose: Pose, aspect: float) -> float:
    """The vertical field of view at which a window of another aspect ratio shows the camera's whole image."""
    half = math.tan(pose.fov / 2)
    return 2 * math.atan(half * max(1.0, pose.aspect / aspect))
