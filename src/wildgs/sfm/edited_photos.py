"""Cameras of photos that were cropped or stretched: their principal points and aspect ratios.

The principal point of a camera is the centre of its photos, but not of what somebody cut out of one, and web photos
often are cut. Some are also resized to another aspect ratio. Bundle adjustment cannot free the principal points of
all photos without a prior, because a turned camera with another one sees almost the same, and COLMAP has none. Each
photo's camera is therefore fitted alone to the points as they are, in turns with bundle adjustment, which moves the
points.

Priors of the principal point's distance from the centre and of the logarithm of the aspect ratio are Cauchy
distributions: most photos are as their cameras made them, and those that are not may be cut by half. They are
weighed against residuals like the priors of lenses (`wildgs.sfm.lens_priors`).
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

import numpy as np
import pycolmap
from jaxtyping import Float64
from scipy.optimize import least_squares

from wildgs.sfm.config import CONFIRMED
from wildgs.sfm.lens_priors import RESIDUAL

CENTER_SPREAD = 0.03
"""Scale of the prior of the principal point's distance from the centre, relative to the longer side."""

ASPECT_SPREAD = 0.005
"""Scale of the prior of the logarithm of the aspect ratio of pixels."""

LEAST_GAIN = 5.0
"""Smallest gain in logarithm of the posterior probability from which a photo is taken for cropped or stretched.
Otherwise its principal point is the centre, and its pixels are square."""

LEAST_OBSERVATIONS = 40
"""Smallest number of observations of points that others confirm, from which a photo's camera is fitted."""

EVALUATIONS = 60
"""Upper bound on evaluations of the residuals of a photo, without those for derivatives."""

WHOLE, CROPPED, STRETCHED = 8, 10, 11
"""Numbers of parameters of a photo: rotation about the middle of the points (a rotation vector), translation
relative to their distance, logarithm of the focal length, distortion of the outermost point; displacement of the
principal point from the centre relative to the longer side; and logarithm of the aspect ratio."""

MOST = 2.0
"""Largest change of a logarithm, beyond which least squares may look for a solution but does not find one."""


def fit_edited(model: Any, scale: float, constant: Collection[int] = ()) -> int:
    """Fits pose and lens of each photo, principal point and aspect ratio included, to a model's points, in place.

    Stretched photos have OPENCV cameras afterwards, of which only the first distortion coefficient is not 0, others
    SIMPLE_RADIAL ones.

    Args:
        model: pycolmap's reconstruction.
        scale: Error from which the loss, that of Cauchy, grows more slowly than the squared one, pixels.
        constant: Ids of cameras that stay as they are.

    Returns:
        The number of photos with a new camera.
    """
    fitted = 0
    for photo in model.reg_image_ids():
        image = model.image(photo)
        if image.camera_id not in constant and image.camera.model_name in ("SIMPLE_RADIAL", "OPENCV"):
            fitted += _fit(model, image, scale)
    return fitted


def has_edited(model: Any) -> bool:
    """Whether a photo of a model is cropped or stretched, by its camera."""
    return any(
        camera.model_name == "OPENCV"
        or (camera.principal_point_x, camera.principal_point_y) != (camera.width / 2, camera.height / 2)
        for camera in (model.image(photo).camera for photo in model.reg_image_ids())
    )


def describe_edited(model: Any) -> dict[str, str]:
    """How photos were cropped or stretched, by their cameras in a model; whole photos are left out.

    Args:
        model: pycolmap's reconstruction.

    Returns:
        Text by name of the image; principal points in percent of the photo's sides, to the right and down.
    """
    found = {}
    for photo in model.reg_image_ids():
        image = model.image(photo)
        camera, said = image.camera, []
        right = round(100 * camera.principal_point_x / camera.width) - 50
        down = round(100 * camera.principal_point_y / camera.height) - 50
        if right or down:
            said.append(
                f"cropped: its principal point is {right:+}% of the width and {down:+}% of the height from its"
                " centre"
            )
        if camera.model_name == "OPENCV":
            ratio = camera.focal_length_y / camera.focal_length_x
            said.append(f"stretched: its height, relative to its width, is {ratio:.3f} times what it was")
        if said:
            found[image.name] = "; ".join(said)
    return found


def with_square_pixels(model: Any, scale: float) -> Any:
    """A copy of a model in which stretched photos have the SIMPLE_RADIAL cameras that fit its points best.

    Mapping knows no others: it may reset a lens to that of the database.

    Args:
        model: pycolmap's reconstruction.
        scale: Scale of the robust loss, pixels.
    """
    square = pycolmap.Reconstruction(model)
    for photo in square.reg_image_ids():
        image: Any = square.image(photo)
        if image.camera.model_name == "OPENCV":
            problem = _Problem.of(image, *_observed(square, image), scale)
            start = problem.start(CROPPED)
            if not len(problem.pixels) or not problem.apply(problem.solve(start).x, image):
                problem.apply(start, image)
    for camera in square.cameras.values():
        if camera.model_name == "OPENCV":  # of photos without a pose
            lens = _lens(camera)
            camera.model = pycolmap.CameraModelId.SIMPLE_RADIAL
            camera.params = [float(value) for value in lens[:4]]
    return square


def _fit(model: Any, image: Any, scale: float) -> bool:
    pixels, points = _observed(model, image)
    if len(pixels) < LEAST_OBSERVATIONS:
        return False
    problem = _Problem.of(image, pixels, points, scale)
    best = problem.solve(problem.start(WHOLE))
    for parameters in (CROPPED, STRETCHED):
        trial = problem.solve(problem.start(parameters))
        if best.cost - trial.cost > LEAST_GAIN * (RESIDUAL * scale) ** 2:
            best = trial
    return problem.apply(best.x, image)


def _observed(model: Any, image: Any) -> tuple[Float64[np.ndarray, "N 2"], Float64[np.ndarray, "N 3"]]:
    """Pixels and places of an image's points that enough photos show."""
    observations = [
        (observation.xy, point.xyz)
        for observation in image.get_observation_points2D()
        if (point := model.point3D(observation.point3D_id)).track.length() >= CONFIRMED
    ]
    pixels, points = ([each[k] for each in observations] for k in range(2))
    return np.array(pixels, np.float64).reshape(-1, 2), np.array(points, np.float64).reshape(-1, 3)


@dataclass(frozen=True)
class _Problem:
    """Residuals of a photo by changes of its camera, of which there are `WHOLE`, `CROPPED` or `STRETCHED`.

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
    ) -> _Problem:
        """The problem of an image that observes points at pixels."""
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
            _lens(camera),
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
            loss=self.loss,  # pyright: ignore[reportArgumentType]  # a function may be given, too
            x_scale="jac",
            max_nfev=EVALUATIONS,
        )

    def residuals(self, changes: Float64[np.ndarray, " C"]) -> Float64[np.ndarray, " R"]:
        """Errors of the projected points, pixels, and what has a prior, relative to its scale."""
        turn = pycolmap.Rotation3d(changes[:3]).matrix()
        x, y, z = (self.arms @ turn.T + self._moved(changes)).T
        focal, *principal, radial, aspect = self._changed(changes)
        rays = np.stack([x, y], axis=1) / np.maximum(z, 1e-9)[:, None]
        bent = rays * (1 + radial * (rays**2).sum(axis=1, keepdims=True))
        errors = focal * bent * [1, np.exp(np.clip(aspect, -MOST, MOST))] + np.array(principal) - self.pixels
        distance = np.hypot(*(np.array(principal) - self.center)) / (CENTER_SPREAD * self.side)
        return np.append(errors, [distance, aspect / ASPECT_SPREAD])

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


def _lens(camera: Any) -> Float64[np.ndarray, "5"]:
    if camera.model_name == "OPENCV":
        across, down, x, y, radial, *_ = camera.params
        return np.array([across, x, y, radial, math.log(down / across)])
    return np.array([*camera.params, 0.0])
