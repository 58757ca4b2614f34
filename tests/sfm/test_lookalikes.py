from contextlib import closing
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from wildgs.sfm.lookalikes import count_agreeing


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
    image = model.image(model.reg_image_ids()[0])
    turned = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.0, 0.05, 0.1])), np.array([0.3, 0.0, 0.0]))
    image.frame.set_cam_from_world(image.camera_id, turned * image.cam_from_world())
    after, same = count_agreeing(model, file)
    share = 2 / len(model.reg_image_ids())  # of the pairs, those with this photo
    assert same == matches
    assert before * (1 - 1.3 * share) < after < before * (1 - 0.7 * share)


def test_photos_without_a_pose_do_not_count(made: tuple[pycolmap.Reconstruction, Path]) -> None:
    model, file = made
    for number in list(model.reg_image_ids()):
        model.deregister_frame(model.image(number).frame_id)
    assert count_agreeing(model, file) == (0, 0)
