"""The kernel that compares descriptors near epipolar lines, against all of them compared one by one."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from wildgs.sfm.guided_kernels import find_clear
from wildgs.threads import launch

SAME_PLACE, LARGEST, RATIO = 3.0, 0.8, 0.8
SIDE = 200.0


def clear_match(
    line: np.ndarray, limit: float, descriptor: np.ndarray, rays: np.ndarray, limits: np.ndarray,
    others: np.ndarray, pixels: np.ndarray,
) -> int:  # fmt: skip
    """The match of one feature, with square roots and arc cosines of everything."""
    distances = np.abs(line @ np.concatenate([rays, np.ones((1, rays.shape[1]))]))
    near = np.flatnonzero(distances < np.minimum(limit, limits))
    if not len(near):
        return -1
    angles = np.arccos(np.minimum(others[near] @ descriptor, 1))
    best = int(np.argmin(angles))
    elsewhere = np.linalg.norm(pixels[near] - pixels[near[best]], axis=1) > SAME_PLACE
    second = min(angles[elsewhere], default=np.pi / 2)
    return int(near[best]) if angles[best] < min(LARGEST, RATIO * second) else -1


@settings(max_examples=25, deadline=None)
@given(
    features=st.integers(0, 40),
    count=st.integers(0, 150),
    looks=st.integers(1, 20),
    lost=st.floats(0, 1),
    seed=st.integers(0, 2**32 - 1),
)
def test_matches_are_those_of_comparing_all(
    features: int, count: int, looks: int, lost: float, seed: int
) -> None:
    random = np.random.default_rng(seed)
    looking = random.random((looks, 128)) ** 2

    def descriptors(number: int) -> np.ndarray:
        each = looking[random.integers(0, looks, number)] + 0.3 * random.random((number, 128))
        return (each / np.linalg.norm(each, axis=1, keepdims=True)).astype(np.float32)

    lines = random.normal(size=(features, 3)).astype(np.float32)
    limits = random.random(features).astype(np.float32) * 0.5
    rays = random.uniform(-1, 1, (2, count)).astype(np.float32)
    rays[:, random.random(count) < lost] = np.nan
    other_limits = random.random(count).astype(np.float32) * 0.5
    firsts, others = descriptors(features), descriptors(count)
    pixels = np.round(random.random((count, 2)) * SIDE / 8) * 8
    found = np.full(features, -2)
    launch(
        find_clear, lines, limits, firsts, rays, other_limits, others, pixels, SAME_PLACE, LARGEST, RATIO, found,
        items=features,
    )  # fmt: skip
    expected = [
        clear_match(lines[row], float(limits[row]), firsts[row], rays, other_limits, others, pixels)
        for row in range(features)
    ]
    assert found.tolist() == expected


def test_a_feature_without_a_line_has_no_match() -> None:
    """Where strong distortion leaves a feature without a ray, its line is NaN."""
    descriptors = np.eye(2, 128, dtype=np.float32)
    found = np.full(1, -2)
    launch(
        find_clear,
        np.full((1, 3), np.nan, np.float32),
        np.full(1, np.nan, np.float32),
        descriptors[:1],
        np.zeros((2, 2), np.float32),
        np.ones(2, np.float32),
        descriptors,
        np.array([[0.0, 0.0], [50.0, 50.0]]),
        SAME_PLACE,
        LARGEST,
        RATIO,
        found,
    )
    assert found.tolist() == [-1]
