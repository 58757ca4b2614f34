import numpy as np
import pytest

from wildgs.sfm.crops import _scale_of_crop

SIZE = (1000, 700)


def photo_of_features(count: int = 400, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform((0, 0), SIZE, (count, 2))


def matches_of(rows: np.ndarray) -> np.ndarray:
    return np.stack([rows, np.arange(len(rows))], axis=1)


@pytest.mark.parametrize(("scale", "left"), [(1.0, 0.0), (0.4, 0.0), (0.8, 250.0)])
def test_copies_and_crops_are_known_by_scale_and_shift(scale: float, left: float) -> None:
    features = photo_of_features()
    rows = np.flatnonzero(features[:, 0] > left)
    crop = (features[rows] - [left, 0]) * scale + np.random.default_rng(1).normal(0, 0.3, (len(rows), 2))
    size = (int((SIZE[0] - left) * scale), int(SIZE[1] * scale))
    found = _scale_of_crop(features, crop, matches_of(rows), size)
    assert found == pytest.approx(scale, rel=0.01)


def test_wrong_matches_among_the_right_ones_do_not_hide_a_crop() -> None:
    features = photo_of_features()
    moved = features.copy()
    moved[:20] = photo_of_features(20, seed=2)
    assert _scale_of_crop(features, moved, matches_of(np.arange(400)), SIZE) == pytest.approx(1, rel=0.01)


@pytest.mark.parametrize("kind", ["another place", "few of its features", "turned"])
def test_other_views_are_no_crops(kind: str) -> None:
    features = photo_of_features()
    if kind == "another place":  # the same wall from the side
        other = features / (1 + 0.0003 * features[:, :1])
    elif kind == "turned":
        other = features[:, ::-1].copy()
    else:  # the same camera at another hour: it fits, but most features are others
        other = np.concatenate([features[:100], photo_of_features(300, seed=3)])
    count = 100 if kind == "few of its features" else 400
    assert _scale_of_crop(features, other, matches_of(np.arange(count)), SIZE) is None
