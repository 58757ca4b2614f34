"""Bundle adjustment with priors of lenses, on generated photos of points."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pycolmap
import pytest

from wildgs.sfm import lens_priors
from wildgs.sfm.lens_priors import (
    FOCAL_SPREAD,
    KNOWN_FOCAL_SPREAD,
    ROBUST_SCALE,
    USUAL_SHIFT,
    WIDE_SHIFT,
    LensPrior,
    adjust_with_priors,
)
from wildgs.sfm.lenses import corner_shift

WIDTH, HEIGHT = 640, 480


def camera(focal: float, number: int = 1, *, known: bool = False, radial: float = 0.0) -> Any:
    """A camera whose focal length is given relative to the longer side."""
    made = pycolmap.Camera(
        model="SIMPLE_RADIAL",
        width=WIDTH,
        height=HEIGHT,
        params=[focal * WIDTH, WIDTH / 2, HEIGHT / 2, radial],
        camera_id=number,
    )
    made.has_prior_focal_length = known
    return made


def photographed(
    focal: float, spread: float, *, radial: float = 0.0, deep: float = 2.0, noise: float = 0.5
) -> Any:
    """A model of points at depth 10, give or take `deep`, in photos from places that are `spread` apart."""
    random = np.random.default_rng(0)
    model = pycolmap.Reconstruction()
    width = 4 / focal
    points = np.stack([random.uniform(-w, w, 150) for w in (width, 0.7 * width, deep)], axis=1) + [0, 0, 10]
    tracks = [pycolmap.Track() for _ in points]
    for number in range(1, 7):
        lens = camera(focal, number, radial=radial)
        model.add_camera_with_trivial_rig(lens)
        pose = pycolmap.Rigid3d(
            pycolmap.Rotation3d(random.normal(0, 0.02, 3)), random.normal(0, spread, 3) * [1, 1, 0.3]
        )
        places = lens.img_from_cam(pose * points)
        image = pycolmap.Image(name=f"{number}.jpg", camera_id=number, image_id=number)
        image.points2D = pycolmap.Point2DList(
            [pycolmap.Point2D(place + random.normal(0, noise, 2)) for place in places]
        )
        model.add_image_with_trivial_frame(image, pose)
        for row, track in enumerate(tracks):
            track.add_element(number, row)
    for point, track in zip(points, tracks, strict=True):
        model.add_point3D(point, track)
    return model


def focals(model: Any) -> np.ndarray:
    return np.array([lens.mean_focal_length() / WIDTH for lens in model.cameras.values()])


def usual(model: Any) -> dict[int, LensPrior]:
    return {number: LensPrior.of(lens) for number, lens in model.cameras.items()}


def test_prior_is_exif_or_usual() -> None:
    assert LensPrior.of(camera(2.5, known=True)) == LensPrior(2.5 * WIDTH, KNOWN_FOCAL_SPREAD)
    assert LensPrior.of(camera(2.5)) == LensPrior(1.2 * WIDTH, FOCAL_SPREAD)


@pytest.mark.parametrize("focal", [0.6, 1.0, 4.0])
def test_photos_outweigh_the_prior_if_they_determine_lenses(focal: float) -> None:
    model = photographed(focal, spread=3.0)
    adjust_with_priors(model, usual(model), corner_shift=USUAL_SHIFT)
    assert np.abs(np.log(focals(model) / focal)).max() < 0.1


def test_distortion_is_measured_if_photos_determine_it() -> None:
    corner = math.hypot(WIDTH, HEIGHT) / 2 / WIDTH
    model = photographed(1.0, spread=3.0, radial=-0.1 / corner**2)
    for lens in model.cameras.values():
        lens.params = [*lens.params[:3], 0.0]
    adjust_with_priors(model, usual(model), corner_shift=WIDE_SHIFT)
    assert np.median([corner_shift(lens) for lens in model.cameras.values()]) == pytest.approx(-0.1, abs=0.02)


def test_priors_hold_lenses_that_photos_do_not_determine() -> None:
    """A nearly flat scene. Without priors, the same adjustment ends at half of the focal length."""
    model = photographed(1.0, spread=0.3, deep=0.02, noise=1.0)
    loose = pycolmap.Reconstruction(model)
    wide = {number: LensPrior(prior.focal, 100.0) for number, prior in usual(model).items()}
    adjust_with_priors(loose, wide, corner_shift=None, rounds=8)
    adjust_with_priors(model, usual(model), corner_shift=None, rounds=8)
    held, left = (abs(float(np.log(focals(each)).mean())) for each in (model, loose))
    assert held < 0.2
    assert left > 0.5


def test_adjustment_keeps_the_model_but_for_numbers() -> None:
    model = photographed(1.0, spread=3.0)
    before = model.num_images(), model.num_cameras(), model.num_points3D(), model.compute_num_observations()
    adjust_with_priors(model, usual(model), corner_shift=USUAL_SHIFT)
    after = model.num_images(), model.num_cameras(), model.num_points3D(), model.compute_num_observations()
    assert after == before
    assert model.compute_mean_reprojection_error() < 1.0


def test_distortion_stays_unless_asked() -> None:
    model = photographed(1.0, spread=3.0, radial=0.05)
    adjust_with_priors(model, usual(model), corner_shift=None)
    assert [lens.params[3] for lens in model.cameras.values()] == [0.05] * 6


def test_constant_lenses_stay() -> None:
    model = photographed(1.0, spread=3.0)
    model.camera(2).params = [700.0, WIDTH / 2, HEIGHT / 2, 0.01]
    adjust_with_priors(model, usual(model), corner_shift=USUAL_SHIFT, constant=[2])
    assert list(model.camera(2).params) == [700.0, WIDTH / 2, HEIGHT / 2, 0.01]
    assert focals(model)[0] != 1.0


def test_an_unusable_solution_changes_nothing() -> None:
    model = photographed(1.0, spread=3.0)
    model.point3D(1).xyz = np.full(3, np.nan)
    before = focals(model)
    adjust_with_priors(model, usual(model), corner_shift=USUAL_SHIFT)
    assert (focals(model) == before).all()


def only_priors(
    lens: Any, *, corner_shift: float | None, robust_scale: float | None = None
) -> tuple[Any, Any]:
    """A model of a lens that no photo shows, and the problem of its pseudo-observations."""
    model, config = pycolmap.Reconstruction(), pycolmap.BundleAdjustmentConfig()
    model.add_camera_with_trivial_rig(lens)
    pseudo = lens_priors._PseudoObservations(model, config, robust_scale)
    if corner_shift is not None:
        pseudo.observe_distortion(model.camera(1), corner_shift)
    else:
        pseudo.observe_focal_length(model.camera(1), LensPrior.of(camera(1.0)))
    return model, config


def solve(model: Any, config: Any) -> None:
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()


def squared_residuals(model: Any) -> float:
    total = 0.0
    for image in model.images.values():
        for point in image.points2D:
            place = image.camera.img_from_cam(image.cam_from_world() * model.point3D(point.point3D_id).xyz)
            total += float(((place - point.xy) ** 2).sum())
    return total


@pytest.mark.parametrize("focal", [0.5, 1.2, 5.0])
def test_focal_prior_alone_leads_to_its_median(focal: float) -> None:
    lens = camera(focal)
    for _ in range(20):
        model, config = only_priors(lens, corner_shift=None)
        solve(model, config)
        lens = camera(max(model.camera(1).mean_focal_length() / WIDTH, 0.05))
    assert lens.mean_focal_length() / WIDTH == pytest.approx(1.2, rel=5e-3)


@pytest.mark.parametrize("robust_scale", [None, 1.0, 0.5])
def test_distortion_prior_has_its_width(robust_scale: float | None) -> None:
    """A displacement of the corners by one standard deviation costs as much as a residual of `RESIDUAL`."""
    corner = math.hypot(WIDTH, HEIGHT) / 2 / (1.3 * WIDTH)
    for shift in (-USUAL_SHIFT, USUAL_SHIFT):
        model, config = only_priors(camera(1.3), corner_shift=USUAL_SHIFT, robust_scale=robust_scale)
        model.camera(1).params = [1.3 * WIDTH, WIDTH / 2, HEIGHT / 2, shift / corner**2]
        config.set_constant_cam_intrinsics(1)
        solve(model, config)
        residual = lens_priors.RESIDUAL * (robust_scale or 1.0)
        assert squared_residuals(model) == pytest.approx(residual**2, rel=0.1)
    model, config = only_priors(camera(1.3), corner_shift=USUAL_SHIFT, robust_scale=robust_scale)
    model.camera(1).params = [1.5 * WIDTH, WIDTH / 2, HEIGHT / 2, 0.0]  # the distance takes the focal length
    config.set_constant_cam_intrinsics(1)
    solve(model, config)
    assert squared_residuals(model) < 1e-3


@pytest.mark.parametrize("robust_scale", [None, 1.0, 0.5])
def test_priors_hold_lenses_under_either_loss(robust_scale: float | None) -> None:
    """A robust loss takes no prior for a wrong match, even if the lens is far from usual."""
    model = photographed(1.0, spread=0.3, deep=0.02, noise=0.3)
    for lens in model.cameras.values():
        lens.params = [6 * WIDTH, *lens.params[1:]]
    known = {number: LensPrior(1.0 * WIDTH, KNOWN_FOCAL_SPREAD) for number in model.cameras}
    adjust_with_priors(model, known, corner_shift=None, rounds=8, robust_scale=robust_scale)
    assert np.abs(np.log(focals(model))).max() < 0.2


def test_lenses_without_a_prior_are_adjusted() -> None:
    model = photographed(1.0, spread=3.0)
    for lens in model.cameras.values():
        lens.params = [1.1 * WIDTH, *lens.params[1:]]
    adjust_with_priors(model, {}, corner_shift=USUAL_SHIFT, rounds=8, robust_scale=ROBUST_SCALE)
    assert np.abs(np.log(focals(model))).max() < 0.05
