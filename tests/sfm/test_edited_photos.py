"""Cameras of cropped and stretched photos, on generated photos of points."""

from __future__ import annotations

import math
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest

from tests.sfm.test_refinement import write_grey_photos
from wildgs.progress import silent
from wildgs.sfm import refinement
from wildgs.sfm.config import SfmConfig
from wildgs.sfm.edited_photos import (
    LEAST_OBSERVATIONS,
    describe_edited,
    fit_edited,
    has_edited,
    with_square_pixels,
)
from wildgs.sfm.lenses import lens_fault, stretched_lenses
from wildgs.sfm.refinement import refine
from wildgs.sfm.workplace import Workplace

NOISE, WIDTH, HEIGHT, FOCAL = 0.3, 1024, 768, 1280.0
CROPPED, STRETCHED = 2, 4
SHIFT, ASPECT = np.array([150.0, -40.0]), 1.07


@pytest.fixture
def made(tmp_path: Path) -> tuple[Workplace, Any]:
    """A workplace and a model; two of its photos were cropped and stretched, which their cameras do not know."""
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_points3D, options.num_rigs, options.num_frames_per_rig = 200, 8, 1
    options.camera_params = [FOCAL, WIDTH / 2, HEIGHT / 2, 0.0]
    work = Workplace(tmp_path)
    with closing(pycolmap.Database.open(work.database)) as database:
        truth = pycolmap.synthesize_dataset(options, database)
        noise = pycolmap.SyntheticNoiseOptions()
        noise.point2D_stddev = NOISE
        model = pycolmap.Reconstruction(truth)
        pycolmap.synthesize_noise(noise, model, database)
    write_grey_photos(work, model)
    photos = sorted(model.reg_image_ids())
    for image, edit in (
        (model.image(photos[CROPPED]), lambda place: place + SHIFT),
        (model.image(photos[STRETCHED]), lambda place: place * [1.0, ASPECT]),
    ):
        for feature in range(image.num_points2D()):
            image.point2D(feature).xy = edit(image.point2D(feature).xy)
    return work, model


def lens(model: Any, row: int) -> Any:
    return model.image(sorted(model.reg_image_ids())[row]).camera


def error(model: Any, row: int) -> float:
    """Median reprojection error of a photo, pixels."""
    image = model.image(sorted(model.reg_image_ids())[row])
    points = [point for point in image.points2D if point.has_point3D()]
    shown = [image.project_point(model.point3D(point.point3D_id).xyz) for point in points]
    return float(np.median([np.linalg.norm(a - b.xy) for a, b in zip(shown, points, strict=True)]))


def test_a_crop_has_another_principal_point(made: tuple[Workplace, Any]) -> None:
    _, model = made
    assert error(model, CROPPED) > 100
    assert fit_edited(model, 0.5) == 8
    camera = lens(model, CROPPED)
    assert camera.model_name == "SIMPLE_RADIAL"
    assert camera.params[0] == pytest.approx(FOCAL, rel=0.02)
    assert np.allclose(camera.params[1:3], np.array([WIDTH / 2, HEIGHT / 2]) + SHIFT, atol=15)
    assert error(model, CROPPED) < 0.6


def test_a_stretched_photo_has_pixels_that_are_not_square(made: tuple[Workplace, Any]) -> None:
    _, model = made
    fit_edited(model, 0.5)
    camera = lens(model, STRETCHED)
    assert stretched_lenses(model) == {camera.camera_id}
    across, down, _, y, *_ = camera.params
    assert down / across == pytest.approx(ASPECT, rel=0.01)
    assert y == pytest.approx(ASPECT * HEIGHT / 2, abs=15)
    assert error(model, STRETCHED) < 0.6


def test_principal_points_of_whole_photos_are_their_centres(made: tuple[Workplace, Any]) -> None:
    _, model = made
    lens(model, 0).params = [FOCAL, WIDTH / 2 + 20, HEIGHT / 2, 0.0]
    fit_edited(model, 0.5)
    for row in set(range(8)) - {CROPPED, STRETCHED}:
        camera = lens(model, row)
        assert camera.model_name == "SIMPLE_RADIAL"
        assert list(camera.params[1:3]) == [WIDTH / 2, HEIGHT / 2]
        assert error(model, row) < 0.6


def test_a_stretched_photo_is_fitted_again_and_may_turn_out_not_to_be(made: tuple[Workplace, Any]) -> None:
    _, model = made
    fit_edited(model, 0.5)
    first = list(lens(model, STRETCHED).params)
    fit_edited(model, 0.5)
    assert np.allclose(lens(model, STRETCHED).params, first, rtol=1e-2, atol=1e-2)
    square = lens(model, 0)
    square.model = pycolmap.CameraModelId.OPENCV
    square.params = [FOCAL, 1.02 * FOCAL, WIDTH / 2, HEIGHT / 2, 0.0, 0.0, 0.0, 0.0]
    fit_edited(model, 0.5)
    assert lens(model, 0).model_name == "SIMPLE_RADIAL"


def test_edited_photos_are_described_and_whole_ones_are_not(made: tuple[Workplace, Any]) -> None:
    _, model = made
    assert describe_edited(model) == {}
    fit_edited(model, 0.5)
    said = describe_edited(model)
    cropped, stretched = (
        model.image(sorted(model.reg_image_ids())[row]).name for row in (CROPPED, STRETCHED)
    )
    assert set(said) == {cropped, stretched}
    assert "+15% of the width and -5% of the height" in said[cropped]
    assert "stretched" not in said[cropped]
    assert "stretched: its height, relative to its width, is 1.07" in said[stretched]


def test_mapping_continues_with_square_pixels(made: tuple[Workplace, Any]) -> None:
    _, model = made
    fit_edited(model, 0.5)
    stretched = lens(model, STRETCHED)
    square = with_square_pixels(model, 1.0)
    assert stretched.model_name == "OPENCV", "the model is not modified"
    assert stretched_lenses(square) == set()
    assert error(model, STRETCHED) < error(square, STRETCHED) < 30
    assert list(lens(square, CROPPED).params) == list(lens(model, CROPPED).params)
    image = model.image(sorted(model.reg_image_ids())[STRETCHED])
    model.deregister_frame(image.frame_id)
    alone = with_square_pixels(model, 1.0).camera(image.camera_id)
    assert alone.model_name == "SIMPLE_RADIAL"
    assert list(alone.params) == [stretched.params[0], *stretched.params[2:5]]


def test_stretched_lenses_can_be_implausible(made: tuple[Workplace, Any]) -> None:
    _, model = made
    fit_edited(model, 0.5)
    camera = lens(model, STRETCHED)
    assert lens_fault(camera) is None
    camera.params = [*camera.params[:4], 9.0, 0.0, 0.0, 0.0]
    assert "distortion" in str(lens_fault(camera))


def test_a_model_of_whole_photos_is_not_adjusted_again(
    made: tuple[Workplace, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    work, model = made
    photos = sorted(model.reg_image_ids())
    for row in (CROPPED, STRETCHED):
        model.deregister_frame(model.image(photos[row]).frame_id)
    assert not has_edited(model)
    monkeypatch.setattr(refinement, "_adjusted", None)
    kept = refinement._with_edited_photos(work, model, {}, 8, SfmConfig(), set())
    assert kept is model
    lens(model, 0).params = [FOCAL, WIDTH / 2 + 1, HEIGHT / 2, 0.0]
    assert has_edited(model)


def test_constant_lenses_and_photos_with_few_points_stay(
    made: tuple[Workplace, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    _, model = made
    camera = lens(model, CROPPED)
    before = list(camera.params)
    assert fit_edited(model, 0.5, {camera.camera_id}) == 7
    assert list(camera.params) == before
    image = model.image(sorted(model.reg_image_ids())[STRETCHED])
    for feature in image.get_observation_point2D_idxs()[LEAST_OBSERVATIONS - 1 :]:
        model.delete_observation(image.image_id, feature)
    assert fit_edited(model, 0.5, {camera.camera_id}) == 6


def test_a_principal_point_outside_the_photo_is_refused(made: tuple[Workplace, Any]) -> None:
    _, model = made
    image = model.image(sorted(model.reg_image_ids())[CROPPED])
    for feature in range(image.num_points2D()):
        image.point2D(feature).xy = image.point2D(feature).xy + [WIDTH, 0.0]
    before = list(image.camera.params)
    assert fit_edited(model, 0.5) == 7
    assert list(image.camera.params) == before


def test_refinement_ends_with_them_and_bundle_adjustment_keeps_their_lenses(
    made: tuple[Workplace, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing can be aligned in grey photos, but all features are taken for aligned here."""
    work, model = made

    def as_they_are(work: Workplace, model: Any, *_: Any) -> tuple[Any, set[tuple[int, int]]]:
        tracks = [model.point3D(point).track for point in model.point3D_ids()]
        return pycolmap.Reconstruction(model), {
            (e.image_id, e.point2D_idx) for t in tracks for e in t.elements
        }

    monkeypatch.setattr(refinement, "refine_keypoints", as_they_are)
    fit_edited(model, 0.5)
    lens(model, CROPPED).params = [FOCAL, WIDTH / 2 + 0.95 * SHIFT[0], HEIGHT / 2 + 0.95 * SHIFT[1], 0.0]
    after = refine(work, model, 8, SfmConfig(), silent, {})
    camera = lens(after, STRETCHED)
    assert camera.model_name == "OPENCV"
    assert list(camera.params[5:]) == [0.0, 0.0, 0.0]
    assert math.log(camera.params[1] / camera.params[0]) == pytest.approx(math.log(ASPECT), abs=0.015)
    moved = np.array(lens(after, CROPPED).params[1:3]) - [WIDTH / 2, HEIGHT / 2]
    assert np.allclose(moved, SHIFT, atol=15)
    assert error(after, CROPPED) < 1
    assert error(after, STRETCHED) < 1
