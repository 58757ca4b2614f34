"""Lenses, and look-alikes, on a made-up scene of ten cameras that see a hundred points."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest

from wildgs.sfm.lenses import drop_impossible, lens_fault
from wildgs.sfm.lookalikes import find_doubtful, judge_pairs


def camera_of(focal: float, radial: float) -> pycolmap.Camera:
    """Of 1,000 x 750 pixels; focal length relative to the long side."""
    return pycolmap.Camera(
        model="SIMPLE_RADIAL", width=1000, height=750, params=[focal * 1000, 500, 375, radial]
    )


@pytest.mark.parametrize(("focal", "radial"), [(0.4, -0.1), (0.7, 0.05), (1.2, -0.3), (9.0, 5.0)])
def test_lenses_of_phones_and_cameras_are_possible(focal: float, radial: float) -> None:
    assert lens_fault(camera_of(focal, radial)) is None


@pytest.mark.parametrize(
    ("focal", "radial", "why"),
    [
        (0.04, 0.0, "171 degrees"),
        (60.0, 0.0, "degrees"),
        (0.5, -0.4, "distortion"),
        (2.9, 19.6, "distortion"),
    ],
)
def test_panoramas_and_little_planets_are_not(focal: float, radial: float, why: str) -> None:
    assert why in str(lens_fault(camera_of(focal, radial)))


@pytest.fixture
def made_up(tmp_path: Path) -> tuple[pycolmap.Reconstruction, Path]:
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig = 10, 1
    options.camera_params = [1280.0, 512.0, 384.0, 0.0]
    file = tmp_path / "database.db"
    with pycolmap.Database.open(file) as database:
        model = pycolmap.synthesize_dataset(options, database)
    return model, file


def test_a_bent_lens_is_straightened_where_the_points_allow_it(
    made_up: tuple[pycolmap.Reconstruction, Path],
) -> None:
    model, _ = made_up
    straight, planet = (model.image(i) for i in model.reg_image_ids()[:2])
    points = straight.num_points3D
    straight.camera.params = [1280.0, 512.0, 384.0, 3.0]
    for image, radial in ((straight, 3.0), (planet, -3.0)):
        image.camera.params = [1280.0, 512.0, 384.0, radial]
    noise = np.random.default_rng(0)
    for point in planet.points2D:  # what no plain lens explains
        point.xy = noise.uniform((0, 0), (1024, 768))
    faults = drop_impossible(model)
    assert list(faults) == [planet.name]
    assert "distortion" in faults[planet.name]
    assert model.num_reg_images() == 9
    assert model.image(straight.image_id).camera.params[3] == 0
    assert model.image(straight.image_id).num_points3D > 0.9 * points
    assert drop_impossible(model) == {}


def test_matches_that_contradict_the_poses_make_a_photo_doubtful(
    made_up: tuple[pycolmap.Reconstruction, Path],
) -> None:
    model, file = made_up
    names = {model.image(i).name: f"photo {i}" for i in model.reg_image_ids()}
    assert find_doubtful(judge_pairs(model, file), names) == {}
    wrong = model.image(model.reg_image_ids()[3])
    other = model.image(model.reg_image_ids()[7])
    wrong.frame.set_cam_from_world(wrong.camera_id, other.cam_from_world())
    doubtful = find_doubtful(judge_pairs(model, file), names)
    assert list(doubtful) == [wrong.name]
    assert "contradict its pose" in doubtful[wrong.name]
