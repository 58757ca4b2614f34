"""Initial pairs: those that other photos continue come first, and copies are left out."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest

from wildgs.sfm.initial_pairs import ENOUGH_SEEN, LEAST_ANGLE, LEAST_SEEN, count_seen, initial_pairs


def rows(start: int, count: int) -> np.ndarray:
    """Matches of features with the same number in both photos."""
    numbers = np.arange(start, start + count)
    return np.stack([numbers, numbers], axis=1)


def test_only_matches_that_others_share_count() -> None:
    neighbours = {
        1: {2: rows(0, 100), 3: rows(0, 20), 4: rows(90, LEAST_SEEN - 1)},
        2: {1: rows(0, 100), 3: rows(15, 10), 5: rows(0, 80), 6: rows(200, 50)},
    }
    # 3 matches 25 of them, with both photos; 4 too few; 5 more than enough; 6 others
    assert count_seen(neighbours, 1, 2) == 25 + ENOUGH_SEEN


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, pycolmap.Reconstruction]:
    """Database of eight photos around a scene, and their true poses."""
    pycolmap.set_random_seed(0)
    file = tmp_path_factory.mktemp("photos") / "database.db"
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 8, 1, 300
    with pycolmap.Database.open(file) as database:
        model = pycolmap.synthesize_dataset(options, database)
    return file, model


def angle(model: pycolmap.Reconstruction, pair: tuple[int, int]) -> float:
    """Median angle between the rays to the points that both images see, degrees."""
    first, second = (model.image(photo) for photo in pair)
    common = {p.point3D_id for p in first.get_observation_points2D()} & {
        p.point3D_id for p in second.get_observation_points2D()
    }
    angles = []
    for point in common:
        rays = [model.point3D(point).xyz - image.projection_center() for image in (first, second)]
        cosine = rays[0] @ rays[1] / np.linalg.norm(rays[0]) / np.linalg.norm(rays[1])
        angles.append(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
    return float(np.median(angles))


def test_pairs_from_different_places_are_found(photos: tuple[Path, pycolmap.Reconstruction]) -> None:
    file, model = photos
    pairs = list(initial_pairs(file))
    assert pairs
    assert len(set(pairs)) == len(pairs)
    assert all(angle(model, pair) > LEAST_ANGLE / 2 for pair in pairs)


def test_photos_that_are_not_asked_for_are_left_out(photos: tuple[Path, pycolmap.Reconstruction]) -> None:
    file, model = photos
    names = {model.image(photo).name for photo in sorted(model.reg_image_ids())[:4]}
    pairs = list(initial_pairs(file, names))
    assert pairs
    assert {model.image(photo).name for pair in pairs for photo in pair} <= names


def test_copies_are_no_pair(photos: tuple[Path, pycolmap.Reconstruction], tmp_path: Path) -> None:
    file, _ = photos
    copy = tmp_path / "database.db"
    copy.write_bytes(file.read_bytes())
    with pycolmap.Database.open(copy) as database:
        first, *others = sorted(image.image_id for image in database.read_all_images())
        keypoints = database.read_keypoints(first)
        image = pycolmap.Image(name="copy.jpg", camera_id=database.read_image(first).camera_id)
        added = database.write_image(image)
        database.write_keypoints(added, keypoints)
        for other in others:
            geometry = database.read_two_view_geometry(first, other)
            database.write_two_view_geometry(added, other, geometry)
        same = pycolmap.TwoViewGeometry()
        same.config = pycolmap.TwoViewGeometryConfiguration.UNCALIBRATED
        same.inlier_matches = rows(0, len(keypoints)).astype(np.uint32)
        database.write_two_view_geometry(first, added, same)
    pairs = list(initial_pairs(copy))
    assert any(added in pair for pair in pairs), "it pairs with photos of other places"
    assert (first, added) not in pairs
