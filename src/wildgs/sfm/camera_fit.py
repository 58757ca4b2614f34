"""Fits the camera of one photo, cropped or stretched ones included, to points of a model by least squares.

Priors of the principal point's distance from the centre and of the logarithm of the aspect ratio are Cauchy
distributions: most photos are as their cameras made them, and those that are not may be cut by half. They are
weighed against residuals like the priors of lenses (`wildgs.sfm.lens_priors`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import pycolmap
from jaxtyping import Float64
from scipy.optimize import least_squares

from wildgs.sfm.lens_priors import RESIDUAL

CENTER_SPREAD = 0.03
"""Scale of the prior of the principal point's distance from the centre, relative to the longer side."""

ASPECT_SPREAD = 0.005
"""Scale of the prior of the logarithm of the aspect ratio of pixels."""

EVALUATIONS = 60
"""Upper bound on evaluations of the residuals of a photo, without those for derivatives."""

WHOLE, CROPPED, STRETCHED = 8, 10, 11
"""Numbers of parameters of a photo: rotation about the middle of the points (a rotation vector), translation
relative to their distance, logarithm of the focal length, distortion of the outermost point; displacement of the
principal point from the centre relative to the longer side; and logarithm of the aspect ratio."""

MOST = 2.0
"""Largest change of a logarithm, beyond which least squares may look for a solution but does not find one."""


@dataclass(frozen=True)
class CameraFit:
    """Least squares of a photo's camera, by changes of which there are `WHOLE`, `CROPPED` or `STRETCHED`.

    Attributes:
        pixels: Where the photo shows the points.
        arms: The points relative to their middle, in axes of the camera.
        middle: Their middle in the camera's frame.
        rotation: The camera's rotation from the world.
        origin: Middle of the points in the world.
        lens: Focal length, principal point, distortion, and logarithm of the aspect ratio.
        center: Centre of the photo, pixels.
        side: Its longer side, pixels.
        edge: Squared tangent of the angle of the outermost point.
        scale: Scale of the robust loss, pixels.
    """

    pixels: Float64[np.ndarray, "N 2"]
    arms: Float64[np.ndarray, "N 3"]
    middle: Float64[np.ndarray, "3"]
    rotation: Any
    origin: Float64[np.ndarray, "3"]
    lens: Float64[np.ndarray, "5"]
    center: Float64[np.ndarray, "2"]
    side: float
    edge: float
    scale: float

    @classmethod
    def of(
        cls, image: Any, pixels: Float64[np.ndarray, "N 2"], points: Float64[np.ndarray, "N 3"], scale: float
    ) -> CameraFit:
        """The fit of an image that observes points at pixels."""
        camera, pose = image.camera, image.cam_from_world()
        inside = pose * points
        middle = inside.mean(axis=0) if len(inside) else np.array([0.0, 0.0, 1.0])
        slopes = inside[:, :2] / np.maximum(inside[:, 2:], 1e-9)
        return cls(
            pixels,
            inside - middle,
            middle,
            pose.rotation,
            pose.inverse() * middle,
            lens_of(camera),
            np.array([camera.width, camera.height]) / 2,
            float(max(camera.width, camera.height)),
            float((slopes**2).sum(axis=1).max(initial=1e-9)),
            scale,
        )

    def start(self, parameters: int) -> Float64[np.ndarray, " C"]:
        """The changes of the present camera, as far as there are parameters."""
        changes = np.zeros(STRETCHED)
        changes[WHOLE:CROPPED] = (self.lens[1:3] - self.center) / self.side
        changes[CROPPED] = self.lens[4]
        return changes[:parameters]

    def solve(self, start: Float64[np.ndarray, " C"]) -> Any:
        """The best changes from a start on, and half the sum of the losses."""
        return least_squares(
            self.residuals,
            start,
            jac=self.jacobian,  # pyright: ignore[reportArgumentType]
            loss=self.loss,  # pyright: ignore[reportArgumentType]  # a function may be given, too
            x_scale="jac",
            max_nfev=EVALUATIONS,
        )

    def residuals(self, changes: Float64[np.ndarray, " C"]) -> Float64[np.ndarray, " R"]:
        """Errors of the projected points, pixels, and what has a prior, relative to its scale."""
        turn = pycolmap.Rotation3d(changes[:3]).matrix()
        focal, *principal, radial, aspect = self._changed(changes)
        rays, _ = self._rays(turn, changes)
        bent = rays * (1 + radial * (rays**2).sum(axis=1, keepdims=True))
        errors = focal * bent * [1, np.exp(np.clip(aspect, -MOST, MOST))] + np.array(principal) - self.pixels
        distance = np.hypot(*(np.array(principal) - self.center)) / (CENTER_SPREAD * self.side)
        return np.append(errors, [distance, aspect / ASPECT_SPREAD])

    def jacobian(self, changes: Float64[np.ndarray, " C"]) -> Float64[np.ndarray, "R C"]:
        """Derivatives of the residuals by the changes."""
        turn = pycolmap.Rotation3d(changes[:3]).matrix()
        focal, _, _, radial, aspect = self._changed(changes)
        rays, depth = self._rays(turn, changes)
        square = (rays**2).sum(axis=1)
        scales = focal * np.array([1, np.exp(np.clip(aspect, -MOST, MOST))])
        outer = rays[:, :, None] * rays[:, None]
        bend = (1 + radial * square)[:, None, None] * np.eye(2) + 2 * radial * outer
        divide = np.concatenate([np.tile(np.eye(2), (len(rays), 1, 1)), -rays[:, :, None]], axis=2)
        by_place = scales[:, None] * (bend @ divide) / depth[:, None, None]
        result = np.zeros((len(rays), 2, len(changes)))
        result[..., :3] = by_place @ (-turn @ _cross(self.arms) @ _right_jacobian(changes[:3]))
        result[..., 3:6] = by_place * np.linalg.norm(self.middle)
        result[..., 6] = scales * rays * (1 + radial * square[:, None])
        result[..., 7] = scales * rays * square[:, None] / self.edge
        priors = np.zeros((2, len(changes)))
        if len(changes) > WHOLE:
            result[:, [0, 1], [WHOLE, WHOLE + 1]] = self.side
            shift = changes[WHOLE:CROPPED]
            priors[0, WHOLE:CROPPED] = shift / max(float(np.hypot(*shift)), 1e-12) / CENTER_SPREAD
        if len(changes) > CROPPED:
            result[:, 1, CROPPED] = result[:, 1, 6]
            priors[1, CROPPED] = 1 / ASPECT_SPREAD
        return np.concatenate([result.reshape(-1, len(changes)), priors])

    def loss(self, squared: Float64[np.ndarray, " R"]) -> Float64[np.ndarray, "3 R"]:
        """The loss of squared residuals and its derivatives: that of Cauchy for all, the last two being priors'."""
        scales = np.full(len(squared), self.scale**2)
        factors = scales.copy()
        scales[-2:], factors[-2:] = 1.0, 2 * (RESIDUAL * self.scale) ** 2
        ratio = squared / scales
        slope = factors / scales / (1 + ratio)
        return np.stack([factors * np.log1p(ratio), slope, -slope / scales / (1 + ratio)])

    def apply(self, changes: Float64[np.ndarray, " C"], image: Any) -> bool:
        """Changes an image's camera and pose, unless its principal point would be outside.

        Returns:
            Whether it did.
        """
        focal, x, y, radial, aspect = (float(value) for value in self._changed(changes))
        camera = image.camera
        if not (0 < x < camera.width and 0 < y < camera.height and abs(aspect) < MOST):
            return False
        if aspect:
            camera.model = pycolmap.CameraModelId.OPENCV
            camera.params = [focal, focal * math.exp(aspect), x, y, radial, 0.0, 0.0, 0.0]
        else:
            camera.model = pycolmap.CameraModelId.SIMPLE_RADIAL
            camera.params = [focal, x, y, radial]
        rotation = pycolmap.Rotation3d(changes[:3]) * self.rotation
        translation = self._moved(changes) - rotation * self.origin
        image.frame.set_cam_from_world(image.camera_id, pycolmap.Rigid3d(rotation, translation))
        return True

    def _rays(
        self, turn: Float64[np.ndarray, "3 3"], changes: Float64[np.ndarray, " C"]
    ) -> tuple[Float64[np.ndarray, "N 2"], Float64[np.ndarray, " N"]]:
        """The points at z = 1 in the camera's frame, and their depths."""
        x, y, z = (self.arms @ turn.T + self._moved(changes)).T
        depth = np.maximum(z, 1e-9)
        return np.stack([x, y], axis=1) / depth[:, None], depth

    def _moved(self, changes: Float64[np.ndarray, " C"]) -> Float64[np.ndarray, "3"]:
        return self.middle + changes[3:6] * np.linalg.norm(self.middle)

    def _changed(self, changes: Float64[np.ndarray, " C"]) -> Float64[np.ndarray, "5"]:
        focal, _, _, radial, _ = self.lens
        shift = changes[WHOLE:CROPPED] if len(changes) > WHOLE else np.zeros(2)
        return np.array(
            [
                focal * np.exp(np.clip(changes[6], -MOST, MOST)),
                *(self.center + self.side * shift),
                radial + changes[7] / self.edge,
                changes[CROPPED] if len(changes) > CROPPED else 0.0,
            ]
        )


def _cross(vectors: Float64[np.ndarray, "*B 3"]) -> Float64[np.ndarray, "*B 3 3"]:
    """Matrices of the cross product with vectors."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    none = np.zeros_like(x)
    rows = [[none, -z, y], [z, none, -x], [-y, x, none]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _right_jacobian(vector: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3 3"]:
    """How changes of a rotation vector turn the turned frame.

    Source: Chirikjian, "Stochastic models, information theory, and Lie groups", volume 2, 2012, section 10.7.
    """
    angle = float(np.linalg.norm(vector))
    cross = _cross(vector)
    if angle < 1e-4:
        return np.eye(3) - cross / 2
    first, second = (1 - math.cos(angle)) / angle**2, (angle - math.sin(angle)) / angle**3
    return np.eye(3) - first * cross + second * cross @ cross


def lens_of(camera: Any) -> Float64[np.ndarray, "5"]:
    """Focal length, principal point, distortion, and logarithm of the aspect ratio of a camera."""
    if camera.model_name == "OPENCV":
        across, down, x, y, radial, *_ = camera.params
        return np.array([across, x, y, radial, math.log(down / across)])
    return np.array([*camera.params, 0.0])
