"""Guided matching on generated photos of points."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pycolmap
import pytest

from wildgs.sfm.guided_matching import RATIO, Matches, match_guided, neighbours

REACH = 0.003


class EditedDatabase:
    """The features of a database, which can be changed."""

    def __init__(self, database: Any, photos: Iterable[int]) -> None:
        self.keypoints = {photo: np.asarray(database.read_keypoints(photo)) for photo in photos}
        self.descriptors = {photo: np.array(database.read_descriptors(photo).data) for photo in photos}

    def read_keypoints(self, photo: int) -> np.ndarray:
        return self.keypoints[photo]

    def read_descriptors(self, photo: int) -> SimpleNamespace:
        return SimpleNamespace(data=self.descriptors[photo])


@pytest.fixture
def made(tmp_path: Path) -> tuple[Any, EditedDatabase]:
    """A generated model without noise, all of whose photos show all points, and its features."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_points3D = 200
    options.num_rigs, options.num_frames_per_rig = 1, 5
    pycolmap.set_random_seed(0)
    with closing(pycolmap.Database.open(tmp_path / "database.db")) as database:
        model = pycolmap.synthesize_dataset(options, database)
        return model, EditedDatabase(database, model.reg_image_ids())


def share_right(model: Any, matches: Matches) -> tuple[float, float]:
    """Precision and recall of matches."""
    right = total = possible = 0
    for (first, second), indices in matches.items():
        points, others = (
            np.array([feature.point3D_id if feature.has_point3D() else -1 for feature in image.points2D])
            for image in (model.image(first), model.image(second))
        )
        found, other = points[indices[:, 0]], others[indices[:, 1]]
        right += int(((found == other) & (found >= 0)).sum())
        total += len(indices)
        possible += len(np.intersect1d(points[points >= 0], others[others >= 0]))
    return right / max(total, 1), right / possible


def matched(
    made: tuple[Any, EditedDatabase], pair: tuple[int, int] | None = None
) -> dict[tuple[int, int], np.ndarray]:
    """Guided matches of a pair, or of all neighbours."""
    model, database = made
    pairs = neighbours(model, 2, 10) if pair is None else [pair]
    return match_guided(model, database, pairs, REACH, lambda done, total: None)


def make_alike(model: Any, database: EditedDatabase, groups: int) -> None:
    """Gives all points one of a few descriptors, with a little noise, like windows of a facade."""
    random = np.random.default_rng(0)
    looks = random.integers(0, 255, (groups, 128))
    for photo, descriptors in database.descriptors.items():
        for row, feature in enumerate(model.image(photo).points2D):
            if feature.has_point3D():
                look = looks[feature.point3D_id % groups]
                descriptors[row] = np.clip(look + random.integers(-8, 9, 128), 0, 255)


def test_all_points_are_matched(made: tuple[Any, EditedDatabase]) -> None:
    precision, recall = share_right(made[0], matched(made))
    assert precision > 0.98
    assert recall > 0.98


def test_a_feature_has_one_match(made: tuple[Any, EditedDatabase]) -> None:
    for indices in matched(made).values():
        assert len(np.unique(indices[:, 0])) == len(np.unique(indices[:, 1])) == len(indices)


def test_points_that_look_alike_are_told_apart_by_epipolar_lines(made: tuple[Any, EditedDatabase]) -> None:
    model, database = made
    make_alike(model, database, groups=10)
    first, second = (database.descriptors[photo] for photo in neighbours(model, 2, 10)[0])
    units, others = (
        each / np.linalg.norm(each.astype(float), axis=1, keepdims=True) for each in (first, second)
    )
    angles = np.sort(np.arccos(np.clip(units @ others.T, -1, 1)), axis=1)
    assert (angles[:, 0] < RATIO * angles[:, 1]).mean() < 0.2  # Lowe's test rejects them
    precision, recall = share_right(model, matched(made))
    assert precision > 0.95
    assert recall > 0.6


def test_features_of_one_place_are_no_rivals(made: tuple[Any, EditedDatabase]) -> None:
    """The same corner as features of two sizes, with the same descriptor."""
    model, database = made
    pair = neighbours(model, 2, 10)[0]
    keypoints, descriptors = (each[pair[1]] for each in (database.keypoints, database.descriptors))
    moved = keypoints + np.array([0.5, 0.5, 0, 0, 0, 0], np.float32)
    database.keypoints[pair[1]] = np.concatenate([keypoints, moved])
    database.descriptors[pair[1]] = np.concatenate([descriptors, descriptors])
    assert len(matched(made, pair)[pair]) > 0.9 * model.image(pair[1]).num_points3D


def test_wrong_poses_have_few_matches(made: tuple[Any, EditedDatabase]) -> None:
    model, _ = made
    pair = neighbours(model, 2, 10)[0]
    before = matched(made, pair)[pair]
    image = model.image(pair[1])
    turned = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.0, 0.3, 0.2])), np.array([0.5, 0.3, 0.0]))
    image.frame.set_cam_from_world(image.camera_id, turned * image.cam_from_world())
    assert len(matched(made, pair)[pair]) < 0.2 * len(before)


def test_neighbours_share_most_points(made: tuple[Any, EditedDatabase]) -> None:
    model, _ = made
    assert all(first < second for first, second in neighbours(model, 2, 1))
    lonely = model.reg_image_ids()[0]
    for point in list(model.point3D_ids())[5:]:
        track = model.point3D(point).track
        for element in [e for e in track.elements if e.image_id == lonely]:
            model.delete_observation(lonely, element.point2D_idx)
    pairs = neighbours(model, 2, 10)
    assert pairs
    assert not any(lonely in pair for pair in pairs)


def test_a_photo_without_features_has_no_matches(made: tuple[Any, EditedDatabase]) -> None:
    model, database = made
    pair = neighbours(model, 2, 10)[0]
    database.keypoints[pair[0]] = np.zeros((0, 6), np.float32)
    database.descriptors[pair[0]] = np.zeros((0, 128), np.uint8)
    assert matched(made, pair)[pair].shape == (0, 2)


def test_a_model_without_points_has_no_neighbours(made: tuple[Any, EditedDatabase]) -> None:
    model, _ = made
    for point in list(model.point3D_ids()):
        model.delete_point3D(point)
    assert neighbours(model, 5, 1) == []


def test_features_without_a_direction_have_no_matches(made: tuple[Any, EditedDatabase]) -> None:
    """The corners of a photo beyond what its distortion can show."""
    model, _ = made
    pair = neighbours(model, 2, 10)[0]
    lens = model.image(pair[1]).camera
    lens.params = [300.0, *lens.params[1:3], -0.6]
    places = np.array([feature.xy for feature in model.image(pair[1]).points2D])
    lost = np.isnan(lens.cam_from_img(places)).any(axis=1)
    assert lost.any()
    assert not lost[matched(made, pair)[pair][:, 1]].any()
