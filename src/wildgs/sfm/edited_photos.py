"""Cameras of photos that were cropped or stretched: their principal points and aspect ratios.

The principal point of a camera is the centre of its photos, but not of what somebody cut out of one, and web photos
often are cut. Some are also resized to another aspect ratio. Bundle adjustment cannot free the principal points of
all photos without a prior, because a turned camera with another one sees almost the same, and COLMAP has none. Each
photo's camera is therefore fitted alone to the points as they are, in turns with bundle adjustment, which moves the
points (`wildgs.sfm.camera_fit`).
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import numpy as np
import pycolmap
from jaxtyping import Float64

from wildgs.sfm.camera_fit import CROPPED, STRETCHED, WHOLE, CameraFit, lens_of
from wildgs.sfm.config import CONFIRMED
from wildgs.sfm.lens_priors import RESIDUAL

LEAST_GAIN = 5.0
"""Smallest gain in logarithm of the posterior probability from which a photo is taken for cropped or stretched.
Otherwise its principal point is the centre, and its pixels are square."""

LEAST_OBSERVATIONS = 40
"""Smallest number of observations of points that others confirm, from which a photo's camera is fitted."""


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
            fit = CameraFit.of(image, *_observed(square, image), scale)
            start = fit.start(CROPPED)
            if not len(fit.pixels) or not fit.apply(fit.solve(start).x, image):
                fit.apply(start, image)
    for camera in square.cameras.values():
        if camera.model_name == "OPENCV":  # of photos without a pose
            lens = lens_of(camera)
            camera.model = pycolmap.CameraModelId.SIMPLE_RADIAL
            camera.params = [float(value) for value in lens[:4]]
    return square


def _fit(model: Any, image: Any, scale: float) -> bool:
    pixels, points = _observed(model, image)
    if len(pixels) < LEAST_OBSERVATIONS:
        return False
    fit = CameraFit.of(image, pixels, points, scale)
    best = fit.solve(fit.start(WHOLE))
    for parameters in (CROPPED, STRETCHED):
        trial = fit.solve(fit.start(parameters))
        if best.cost - trial.cost > LEAST_GAIN * (RESIDUAL * scale) ** 2:
            best = trial
    return fit.apply(best.x, image)


def _observed(model: Any, image: Any) -> tuple[Float64[np.ndarray, "N 2"], Float64[np.ndarray, "N 3"]]:
    """Pixels and places of an image's points that enough photos show."""
    observations = [
        (observation.xy, point.xyz)
        for observation in image.get_observation_points2D()
        if (point := model.point3D(observation.point3D_id)).track.length() >= CONFIRMED
    ]
    pixels, points = ([each[k] for each in observations] for k in range(2))
    return np.array(pixels, np.float64).reshape(-1, 2), np.array(points, np.float64).reshape(-1, 3)
