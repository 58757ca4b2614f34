"""Bundle adjustment with prior distributions of focal lengths and distortion.

With few photos, the reprojection error hardly depends on some changes of all lenses and points together: long focal
lengths with distant cameras and deep scenes look like short ones with near cameras and flat scenes (the bas-relief
ambiguity, Belhumeur et al., IJCV 1999), and distortion can take part in it. Bundle adjustment without priors then
ends at focal lengths of ten or more long sides. Priors decide where the photos do not, and are outweighed where
they do: the maximum a posteriori estimate instead of that of maximum likelihood.

COLMAP has no such priors. They are expressed by pseudo-observations (Mikhail and Ackermann, "Observations and least
squares", 1976): for each lens, images that do not exist observe points that are known.

- Focal length: an image at a known pose observes a point near its axis. Its residual is proportional to the focal
  length minus a target, which is set anew in each round such that the gradient is that of a log-normal prior.
- Distortion: an image at an unknown pose observes two concentric rings of points in a plane. The distance from the
  plane absorbs the focal length, and the ratio of the radii gives the distortion.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pycolmap

from wildgs.sfm.lenses import stretched_lenses

RESIDUAL = 2.0
"""Standard deviation of an observation's residual against which the priors are weighed, relative to the scale of
the robust loss, or in pixels under the squared one. Residuals are less than half of that, but those of neighbouring
features are not independent."""

USUAL_FOCAL, FOCAL_SPREAD = 1.2, 0.75
"""Median of the prior of a focal length, relative to the longer side (COLMAP's initial value), and the standard
deviation of its logarithm. The photos of three collections have medians of 0.91, 0.94 and 2.4."""

KNOWN_FOCAL_SPREAD = 0.2
"""Standard deviation of the logarithm of a focal length from EXIF data; photos may be cropped."""

USUAL_SHIFT, WIDE_SHIFT = 0.02, 0.15
"""Standard deviations of the displacement of a photo's corners by distortion, relative to their distance from the
centre: of usual photos, and of action cameras and fisheye lenses."""

ROUNDS, CONVERGED = 3, 0.01
"""Upper bound on rounds, and largest change of a focal length's logarithm in the last one."""

ITERATIONS = 30
"""Upper bound on iterations of the solver in a round."""

TOLERANCE = 1e-6
"""Relative decrease of the cost in an iteration below which an adjustment during mapping ends: Ceres's default.
With 0, which is COLMAP's, nearly all iterations are done, and a run of mapping takes twice as long and is no
better. The last adjustments, with a robust loss, do all of them."""

ROBUST_SCALE = 1.0
"""Error from which the robust loss grows more slowly than the squared one, pixels."""

SMALL_RESIDUAL, MOST_COPIES, RING_COPIES = 0.4, 100, 4
"""With a robust loss, which would take a large residual of a pseudo-observation for a wrong match: that of a focal
length is divided among as many observations as make it smaller than the first number, relative to the loss's scale,
but not more than the second; the third is the number of observations of each point of the rings at a scale of 1."""

LEAST_COPIES = 2
"""Number of observations of a point that COLMAP's bundle adjustment needs."""

RING = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
INNER = 0.5
"""Directions of a ring's points, and the radius of the inner ring relative to the outer one."""


@dataclass(frozen=True)
class LensPrior:
    """Prior of a lens.

    Attributes:
        focal: Median focal length, pixels.
        spread: Standard deviation of its logarithm.
    """

    focal: float
    spread: float

    @classmethod
    def of(cls, camera: Any) -> LensPrior:
        """The prior of a camera in COLMAP's database, which knows whether its focal length is from EXIF data."""
        if camera.has_prior_focal_length:
            return cls(camera.mean_focal_length(), KNOWN_FOCAL_SPREAD)
        return cls(USUAL_FOCAL * max(camera.width, camera.height), FOCAL_SPREAD)


def adjust_with_priors(
    model: Any,
    priors: Mapping[int, LensPrior],
    *,
    corner_shift: float | None,
    constant: Collection[int] = (),
    rounds: int = ROUNDS,
    robust_scale: float | None = None,
) -> None:
    """Adjusts poses, points and lenses of a model in place.

    Args:
        model: pycolmap's reconstruction with two registered photos or more.
        priors: Priors by camera id; lenses without one have none.
        corner_shift: Prior standard deviation of the displacement of a photo's corners by distortion, relative to
            their distance from the centre. None keeps distortion as it is.
        constant: Ids of cameras whose lenses stay as they are, like those of stretched photos.
        rounds: Upper bound on the number of bundle adjustments.
        robust_scale: Error from which the loss, that of Cauchy, grows more slowly than the squared one, pixels.
            None for the squared error.
    """
    photos = list(model.reg_image_ids())
    constant = {*constant, *stretched_lenses(model)}
    lenses = sorted({model.image(photo).camera_id for photo in photos} - set(constant))
    trial = pycolmap.Reconstruction(model)
    for _ in range(rounds):
        before = {lens: trial.camera(lens).mean_focal_length() for lens in lenses}
        if not _adjust(trial, photos, lenses, priors, constant, corner_shift, robust_scale):
            return
        changes = [abs(math.log(trial.camera(lens).mean_focal_length() / before[lens])) for lens in lenses]
        if max(changes, default=0.0) < CONVERGED:
            break
    _take_over(model, trial, photos)


def _adjust(
    trial: Any,
    photos: Sequence[int],
    lenses: Sequence[int],
    priors: Mapping[int, LensPrior],
    constant: Collection[int],
    corner_shift: float | None,
    robust_scale: float | None,
) -> bool:
    """One bundle adjustment with pseudo-observations; returns whether its solution is usable."""
    config = pycolmap.BundleAdjustmentConfig()
    for photo in photos:
        config.add_image(photo)
    for lens in constant:
        config.set_constant_cam_intrinsics(lens)
    pseudo = _PseudoObservations(trial, config, robust_scale)
    for lens in lenses:
        camera = trial.camera(lens)
        if lens not in priors:
            continue
        pseudo.observe_focal_length(camera, priors[lens])
        if corner_shift is not None and camera.model_name == "SIMPLE_RADIAL":
            pseudo.observe_distortion(camera, corner_shift)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_extra_params = corner_shift is not None
    options.ceres.solver_options.max_num_iterations = ITERATIONS
    if robust_scale is None:
        options.ceres.solver_options.function_tolerance = TOLERANCE
    else:
        options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
        options.ceres.loss_function_scale = robust_scale
    summary = pycolmap.create_default_bundle_adjuster(options, config, trial).solve()
    pseudo.remove()
    lengths = [trial.camera(lens).mean_focal_length() for lens in lenses]
    return bool(summary.is_solution_usable()) and all(math.isfinite(f) and f > 0 for f in lengths)


class _PseudoObservations:
    """Images that do not exist and their points, in a copy of a model."""

    def __init__(self, trial: Any, config: Any, robust_scale: float | None = None) -> None:
        self._trial, self._config, self._robust = trial, config, robust_scale is not None
        self._residual = RESIDUAL * (ROBUST_SCALE if robust_scale is None else robust_scale)
        self._points: list[int] = []
        self._frames: list[int] = []

    def observe_focal_length(self, camera: Any, prior: LensPrior) -> None:
        """Adds a residual in the focal length whose gradient is that of the prior at the present value."""
        focal = camera.mean_focal_length()
        deviation = math.log(focal / prior.focal) / prior.spread
        target = focal * (1 - deviation * prior.spread)
        many = math.ceil((RESIDUAL * deviation / SMALL_RESIDUAL) ** 2) if self._robust else LEAST_COPIES
        copies = min(max(LEAST_COPIES, many), MOST_COPIES)
        points = np.array([[self._residual / (prior.spread * focal) / math.sqrt(copies), 0.0]])
        self._add(camera, points, points * target, copies=copies, constant=True)

    def observe_distortion(self, camera: Any, corner_shift: float) -> None:
        """Adds residuals in the distortion alone, whose prior has mean 0."""
        diagonal = math.hypot(camera.width, camera.height) / 2
        focal = camera.mean_focal_length()
        # Information about the coefficient in N points of two rings of radius a and INNER a, after the distance
        # from their plane is eliminated: N f^2 a^6 times this number. It should be (residual / its deviation)^2.
        left = 1 + INNER**6 - (1 + INNER**4) ** 2 / (1 + INNER**2)
        copies = RING_COPIES if self._robust else LEAST_COPIES
        number = copies * len(RING)
        outer = (self._residual**2 / (corner_shift**2 * left * number * diagonal**2)) ** (1 / 6)
        radius = outer * diagonal / focal
        points = radius * np.concatenate([RING, INNER * RING])
        self._add(camera, points, points * focal, copies=copies, constant=False)

    def _add(
        self, camera: Any, points: np.ndarray, offsets: np.ndarray, *, copies: int, constant: bool
    ) -> None:
        """Adds an image of points at depth 1, each of which it observes `copies` times.

        Args:
            camera: Its camera.
            points: Places of the points in its plane.
            offsets: Where it observes them, pixels from the principal point.
            copies: Number of observations of each.
            constant: Whether its pose is known.
        """
        trial, number = self._trial, max(self._trial.images, default=0) + 1
        center = np.array([camera.principal_point_x, camera.principal_point_y])
        image = pycolmap.Image(name=f"pseudo/{number}", camera_id=camera.camera_id, image_id=number)
        image.points2D = pycolmap.Point2DList(
            [pycolmap.Point2D(center + offset) for offset in offsets for _ in range(copies)]
        )
        trial.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
        frame = trial.image(number).frame_id
        self._frames.append(frame)
        self._config.add_image(number)
        if constant:
            self._config.set_constant_rig_from_world_pose(frame)
        for row, place in enumerate(points):
            track = pycolmap.Track()
            for copy in range(copies):
                track.add_element(number, copies * row + copy)
            point = trial.add_point3D(np.array([*place, 1.0]), track)
            self._points.append(point)
            self._config.add_constant_point(point)

    def remove(self) -> None:
        """Removes them from the model; the images stay in it without a pose."""
        for point in self._points:
            self._trial.delete_point3D(point)
        for frame in self._frames:
            self._trial.deregister_frame(frame)


def _take_over(model: Any, trial: Any, photos: Sequence[int]) -> None:
    """Copies lenses, poses and points of the copy into the model."""
    for photo in photos:
        image = trial.image(photo)
        model.camera(image.camera_id).params = image.camera.params
        model.image(photo).frame.set_cam_from_world(image.camera_id, image.cam_from_world())
    for point in model.point3D_ids():
        model.point3D(point).xyz = trial.point3D(point).xyz
    model.update_point_3d_errors()
