from contextlib import closing
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch

from wildgs.progress import silent
from wildgs.sfm import incremental, mapping, registration
from wildgs.sfm.config import SfmConfig
from wildgs.sfm.lookalikes import count_agreeing, keeps_agreement
from wildgs.sfm.registration import Registration
from wildgs.sfm.workplace import Workplace


def turn(model: pycolmap.Reconstruction, photos: int) -> None:
    """Gives some photos wrong poses."""
    wrong = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.0, 0.05, 0.1])), np.array([0.3, 0.0, 0.0]))
    for number in list(model.reg_image_ids())[:photos]:
        image = model.image(number)
        image.frame.set_cam_from_world(image.camera_id, wrong * image.cam_from_world())


@pytest.fixture
def made(tmp_path: Path) -> tuple[pycolmap.Reconstruction, Path]:
    """A generated model without noise and the database of its matches."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_points3D = 200
    pycolmap.set_random_seed(0)
    with closing(pycolmap.Database.open(tmp_path / "database.db")) as database:
        model = pycolmap.synthesize_dataset(options, database)
    return model, tmp_path / "database.db"


def test_matches_of_right_poses_agree(made: tuple[pycolmap.Reconstruction, Path]) -> None:
    agreeing, matches = count_agreeing(*made)
    assert agreeing == matches > 1000


def test_a_wrong_pose_loses_its_matches(made: tuple[pycolmap.Reconstruction, Path]) -> None:
    model, file = made
    before, matches = count_agreeing(model, file)
    turn(model, 1)
    after, same = count_agreeing(model, file)
    share = 2 / len(model.reg_image_ids())  # of the pairs, those with this photo
    assert same == matches
    assert before * (1 - 1.3 * share) < after < before * (1 - 0.7 * share)


def test_photos_without_a_pose_do_not_count(made: tuple[pycolmap.Reconstruction, Path]) -> None:
    model, file = made
    for number in list(model.reg_image_ids()):
        model.deregister_frame(model.image(number).frame_id)
    assert count_agreeing(model, file) == (0, 0)


def test_a_changed_model_has_to_agree_with_the_matches(made: tuple[pycolmap.Reconstruction, Path]) -> None:
    model, file = made
    changed = pycolmap.Reconstruction(model)
    assert keeps_agreement(model, changed, file)
    turn(changed, 2)
    assert not keeps_agreement(model, changed, file)
    assert keeps_agreement(changed, model, file)


@pytest.mark.parametrize("wrong", [0, 2])
def test_no_later_step_leaves_poses_that_contradict_the_matches(
    made: tuple[pycolmap.Reconstruction, Path], monkeypatch: pytest.MonkeyPatch, wrong: int
) -> None:
    """Measuring distortion, refinement and adding a photo, each with an adjustment that may turn two photos."""
    model, file = made
    work, count = Workplace(file.parent), model.num_reg_images()

    def adjusted(*_: object, **__: object) -> pycolmap.Reconstruction:
        other = pycolmap.Reconstruction(model)
        turn(other, wrong)
        return other

    monkeypatch.setattr(incremental, "DISTORTION_FROM", count + 1)
    monkeypatch.setattr(incremental, "_finish", lambda model, *_, **__: turn(model, wrong))
    measured = incremental.measure_distortion(work, model, count)
    assert (measured is model) == (wrong > 0)

    monkeypatch.setattr(registration, "refine", adjusted)
    photos = Registration(work, [], torch.zeros(0, 1), SfmConfig(second_chance=False), silent)
    assert (photos.refine(model) is model) == (wrong > 0)

    smaller = pycolmap.Reconstruction(model)
    smaller.deregister_frame(smaller.image(smaller.reg_image_ids()[-1]).frame_id)
    monkeypatch.setattr(mapping, "run_pipeline", lambda *_, **__: [adjusted()])
    larger = mapping.continue_mapping(work, smaller, count, SfmConfig(), silent)
    assert (larger is smaller) == (wrong > 0)


def test_a_model_without_a_new_photo_stays_as_it_is(
    made: tuple[pycolmap.Reconstruction, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    model, file = made
    work = Workplace(file.parent)
    monkeypatch.setattr(mapping, "run_pipeline", lambda *_, **__: [pycolmap.Reconstruction(model)])
    assert (
        mapping.continue_mapping(work, model, model.num_reg_images(), SfmConfig(), silent, constant_lenses=())
        is model
    )
