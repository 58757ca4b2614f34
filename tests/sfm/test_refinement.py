"""The last adjustment of a model, on generated photos of points with wrong matches."""

from __future__ import annotations

import itertools
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from PIL import Image

from wildgs.progress import silent
from wildgs.sfm import incremental, refinement
from wildgs.sfm.config import SfmConfig
from wildgs.sfm.lens_priors import USUAL_SHIFT, LensPrior, adjust_with_priors
from wildgs.sfm.lookalikes import verified_matches
from wildgs.sfm.refinement import CONFIRMED, refine, triangulate, unconfirmed
from wildgs.sfm.workplace import Workplace

NOISE = 0.3


def added_wrong_matches(database: Any, model: Any, share: float) -> None:
    """Adds matches of wrong features near the epipolar lines, which two photos each confirm."""
    random = np.random.default_rng(0)
    photos = sorted(model.reg_image_ids())
    for first, second in itertools.pairwise(photos):
        geometry = database.read_two_view_geometry(first, second)
        rows = random.permutation(len(geometry.inlier_matches))[: int(share * len(geometry.inlier_matches))]
        wrong = geometry.inlier_matches.copy()
        wrong[rows, 1] = wrong[np.roll(rows, 1), 1]
        geometry.inlier_matches = wrong
        database.delete_two_view_geometry(first, second)
        database.write_two_view_geometry(first, second, geometry)


def write_grey_photos(work: Workplace, model: Any) -> None:
    """Writes photos in which nothing can be aligned."""
    for number in model.reg_image_ids():
        image = model.image(number)
        (work.images / image.name).parent.mkdir(parents=True, exist_ok=True)
        Image.new("L", (image.camera.width, image.camera.height), 128).save(work.images / image.name, "PNG")


@pytest.fixture
def made(tmp_path: Path) -> tuple[Workplace, Any, Any]:
    """A workplace with noisy features and some wrong matches, the true model, and one with disturbed cameras."""
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_points3D, options.num_rigs, options.num_frames_per_rig = 150, 10, 1
    options.camera_params = [1280.0, 512.0, 384.0, 0.0]
    work = Workplace(tmp_path)
    with closing(pycolmap.Database.open(work.database)) as database:
        truth = pycolmap.synthesize_dataset(options, database)
        noise = pycolmap.SyntheticNoiseOptions()
        noise.point2D_stddev = NOISE
        noisy = pycolmap.Reconstruction(truth)
        pycolmap.synthesize_noise(noise, noisy, database)
        added_wrong_matches(database, truth, 0.2)
    write_grey_photos(work, noisy)
    random = np.random.default_rng(1)
    for number in noisy.reg_image_ids()[2:]:
        image = noisy.image(number)
        turn = pycolmap.Rigid3d(pycolmap.Rotation3d(random.normal(0, 0.001, 3)), random.normal(0, 0.003, 3))
        image.frame.set_cam_from_world(image.camera_id, turn * image.cam_from_world())
    return work, truth, noisy


def error(model: Any, truth: Any) -> float:
    """Median distance between true places of points and where cameras project them after the best similarity."""
    ours, theirs = (
        np.array([each.image(number).projection_center() for number in sorted(truth.reg_image_ids())])
        for each in (model, truth)
    )
    fit = pycolmap.estimate_sim3d(theirs, ours)
    distances = []
    for number in truth.reg_image_ids():
        image, other = truth.image(number), model.image(number)
        points = np.array([truth.point3D(p.point3D_id).xyz for p in image.points2D if p.has_point3D()])
        right = image.camera.img_from_cam(image.cam_from_world() * points)
        moved = fit.scale * points @ fit.rotation.matrix().T + fit.translation
        distances.append(
            np.linalg.norm(other.camera.img_from_cam(other.cam_from_world() * moved) - right, axis=1)
        )
    return float(np.median(np.concatenate(distances)))


def refined(made: tuple[Workplace, Any, Any], **options: Any) -> Any:
    work, _, model = made
    return refine(work, model, len(model.images), SfmConfig(), silent, {}, **options)


def test_cameras_become_more_exact(made: tuple[Workplace, Any, Any]) -> None:
    _, truth, model = made
    assert error(model, truth) > 1.0
    assert error(refined(made), truth) < 0.5


def test_wrong_matches_move_cameras_less_than_under_squared_errors(made: tuple[Workplace, Any, Any]) -> None:
    work, truth, model = made
    squared = triangulate(model, dict(verified_matches(model.reg_image_ids(), work.database)), SfmConfig())
    priors = {number: LensPrior.of(lens) for number, lens in squared.cameras.items()}
    adjust_with_priors(squared, priors, corner_shift=USUAL_SHIFT, rounds=8)
    assert error(refined(made), truth) < 0.7 * error(squared, truth)


def test_the_given_model_is_not_modified(made: tuple[Workplace, Any, Any]) -> None:
    _, _, model = made
    poses = [model.image(number).cam_from_world().matrix() for number in model.reg_image_ids()]
    points = model.num_points3D()
    refined(made)
    after = [model.image(number).cam_from_world().matrix() for number in model.reg_image_ids()]
    assert np.array_equal(poses, after)
    assert model.num_points3D() == points


def test_the_same_photos_have_poses(made: tuple[Workplace, Any, Any]) -> None:
    _, _, model = made
    assert refined(made).reg_image_ids() == model.reg_image_ids()


def test_constant_lenses_stay(made: tuple[Workplace, Any, Any]) -> None:
    _, _, model = made
    lens = model.image(model.reg_image_ids()[0]).camera_id
    after = refined(made, constant={lens})
    assert list(after.camera(lens).params) == list(model.camera(lens).params)
    assert any(list(after.camera(n).params) != list(model.camera(n).params) for n in model.cameras)


def test_cameras_that_explain_much_less_are_refused(
    made: tuple[Workplace, Any, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A scene that becomes deeper until its points cannot be triangulated loses them."""

    def flatten(work: Workplace, model: Any, count: int, constant: Any, *, scale: float) -> None:
        for number in model.reg_image_ids():
            image = model.image(number)
            pose = pycolmap.Rigid3d(image.cam_from_world().rotation, np.zeros(3))
            image.frame.set_cam_from_world(image.camera_id, pose)

    monkeypatch.setattr(refinement, "adjust_robustly", flatten)
    _, _, model = made
    after = refined(made)
    for number in model.reg_image_ids():
        assert np.allclose(
            after.image(number).cam_from_world().matrix(), model.image(number).cam_from_world().matrix()
        )


def test_triangulation_finds_the_points_of_a_model_without(made: tuple[Workplace, Any, Any]) -> None:
    work, truth, _ = made
    bare = pycolmap.Reconstruction(truth)
    for point in list(bare.point3D_ids()):
        bare.delete_point3D(point)
    again = triangulate(bare, dict(verified_matches(bare.reg_image_ids(), work.database)), SfmConfig())
    assert again.num_points3D() > 0.9 * truth.num_points3D()
    assert bare.num_points3D() == 0


def test_points_of_two_photos_are_unconfirmed_unless_a_photo_needs_them(
    made: tuple[Workplace, Any, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    _, truth, _ = made
    assert unconfirmed(truth) == []
    chosen = sorted(truth.point3D_ids())[:5]
    for point in chosen:
        elements = [(e.image_id, e.point2D_idx) for e in truth.point3D(point).track.elements]
        for element in elements[CONFIRMED - 1 :]:
            truth.delete_observation(*element)
    assert sorted(unconfirmed(truth)) == chosen
    monkeypatch.setattr(refinement, "LEAST_CONFIRMED", 1000)
    assert unconfirmed(truth) == []


def test_two_photos_alone_are_refined(tmp_path: Path) -> None:
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig = 2, 1
    work = Workplace(tmp_path)
    with closing(pycolmap.Database.open(work.database)) as database:
        model = pycolmap.synthesize_dataset(options, database)
    write_grey_photos(work, model)
    after = refine(work, model, 2, SfmConfig(), silent, {})
    assert after.num_reg_images() == 2
    assert after.num_points3D() > 50


def test_guided_matches_are_found_once(
    made: tuple[Workplace, Any, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    work, _, model = made
    guided: dict[tuple[int, int], np.ndarray] = {}
    refine(work, model, len(model.images), SfmConfig(), silent, guided)
    assert guided
    totals = []
    refine(
        work,
        model,
        len(model.images),
        SfmConfig(),
        lambda step, done, total: totals.append(total) if "epipolar" in step else None,
        guided,
    )
    assert len(totals) < len(guided)


def test_very_many_photos_are_adjusted_without_guided_matches(
    made: tuple[Workplace, Any, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(refinement, "GUIDED_LIMIT", 5)
    monkeypatch.setattr(incremental, "PRIORS_LIMIT", 5)
    work, truth, model = made
    guided: dict[tuple[int, int], np.ndarray] = {}
    after = refine(work, model, len(model.images), SfmConfig(), silent, guided)
    assert not guided
    assert error(after, truth) < 0.7 * error(model, truth)
