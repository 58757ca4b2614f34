"""Poses from matches of which most are wrong: a photo of two hundred points with hardly similar descriptors."""

from dataclasses import dataclass, replace

import numpy as np
import pycolmap
import pytest

from wildgs.sfm.consistent_matching import Features, Shapes, find_consistent_pose
from wildgs.sfm.feature_index import FeatureIndex

POINTS, OTHERS = 200, 600
"""Points of the model, and features of the photo that show none of them."""
SEEN = range(0, POINTS, 3)
"""Points that the photo sees."""
TURNED, FOCAL = 0.3, 900.0


@dataclass(frozen=True)
class Case:
    """The photo and the model; feature i shows the i-th of `SEEN`."""

    features: Features
    index: FeatureIndex
    shapes: Shapes
    camera: pycolmap.Camera


@pytest.fixture(scope="module")
def case() -> Case:
    rng = np.random.default_rng(0)
    camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=1000, height=750, params=[1200.0, 500, 375, 0.0])
    points = rng.uniform([-2, -1.5, 5], [2, 1.5, 7], (POINTS, 3))
    described = descriptors(rng, POINTS)
    sizes, angles = rng.uniform(0.01, 0.05, POINTS), rng.uniform(-np.pi, np.pi, POINTS)
    seen = points[SEEN]
    pixels = FOCAL * seen[:, :2] / seen[:, 2:] + [500, 375] + rng.normal(0, 0.5, (len(seen), 2))
    similar = np.sqrt(0.3) * unit(described[SEEN]) + np.sqrt(0.7) * unit(descriptors(rng, len(seen)))
    features = Features(
        np.concatenate([stored(similar), descriptors(rng, OTHERS)]),
        np.concatenate([pixels, rng.uniform(0, [1000, 750], (OTHERS, 2))]),
        Shapes(
            np.concatenate([angles[SEEN] + TURNED, rng.uniform(-np.pi, np.pi, OTHERS)]),
            np.concatenate([sizes[SEEN] * FOCAL / seen[:, 2], 2 ** rng.uniform(0, 4, OTHERS)]),
        ),
    )
    index = FeatureIndex(described, np.arange(POINTS), points)
    return Case(features, index, Shapes(angles, sizes), camera)


def descriptors(rng: np.random.Generator, count: int) -> np.ndarray:
    """As COLMAP stores them; two of them differ by about an angle of 1.2."""
    return stored(rng.exponential(1.0, (count, 128)) ** 0.75)


def unit(values: np.ndarray) -> np.ndarray:
    return values / np.linalg.norm(values, axis=1, keepdims=True)


def stored(values: np.ndarray) -> np.ndarray:
    return np.clip(512 * unit(values.astype(np.float64)), 0, 255).round().astype(np.uint8)


def test_the_pose_is_found_among_wrong_matches(case: Case) -> None:
    found = find_consistent_pose(case.features, case.index, case.shapes, case.camera, 0)
    assert found is not None
    right = np.isin(found.features, np.arange(len(SEEN))) & (found.points == 3 * found.features)
    assert right.sum() >= 40
    assert right.mean() > 0.9
    assert found.camera.mean_focal_length() == pytest.approx(FOCAL, rel=0.1)
    assert case.camera.params[0] == 1200  # is not modified


def test_another_place_has_no_pose(case: Case) -> None:
    rng = np.random.default_rng(1)
    elsewhere = replace(case.features, pixels=rng.uniform(0, [1000, 750], case.features.pixels.shape))
    assert find_consistent_pose(elsewhere, case.index, case.shapes, case.camera, 0) is None


def test_orientation_and_size_are_what_finds_it(case: Case) -> None:
    rng = np.random.default_rng(2)
    shapes = Shapes(rng.uniform(-np.pi, np.pi, POINTS), 10 ** rng.uniform(-3, 0, POINTS))
    assert find_consistent_pose(case.features, case.index, shapes, case.camera, 0) is None


def test_a_photo_without_features_has_no_pose(case: Case) -> None:
    nothing = Features(np.zeros((0, 128), np.uint8), np.zeros((0, 2)), Shapes(np.zeros(0), np.zeros(0)))
    assert find_consistent_pose(nothing, case.index, case.shapes, case.camera, 0) is None


def test_shapes_of_keypoints() -> None:
    turn = np.deg2rad(30)
    shape = 4 * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    shapes = Shapes.of(np.array([[10.0, 20.0, *shape.ravel()]]))
    assert shapes.angles == pytest.approx([turn])
    assert shapes.sizes == pytest.approx([4])
