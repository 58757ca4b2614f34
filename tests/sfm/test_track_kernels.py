"""Alignment of the observations of points, on textures whose warps are known."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from wildgs.sfm.keypoint_refinement import WINDOW, patch_weights
from wildgs.sfm.track_kernels import FARTHEST, align_tracks
from wildgs.threads import kernels_limited, launch

CENTRE = (WINDOW - 1) / 2


def texture(x: np.ndarray, y: np.ndarray, seed: int) -> np.ndarray:
    """A smooth texture of about 128 ± 17 whose values are known everywhere."""
    random = np.random.default_rng(seed)
    waves = random.normal(0, 0.35, (12, 2))
    phases = random.uniform(0, 2 * np.pi, 12)
    return 128 + 7 * sum(np.sin(a * x + b * y + p) for (a, b), p in zip(waves, phases, strict=True))


def window(
    warp: np.ndarray, place: np.ndarray, seed: int, gain: float = 1.0, offset: float = 0.0
) -> np.ndarray:
    """What a photo shows around the point (0, 0) of the texture, which is at `place` from the window's centre."""
    rows, columns = np.mgrid[:WINDOW, :WINDOW] - CENTRE
    u, v = np.linalg.inv(warp) @ np.stack([columns - place[0], rows - place[1]]).reshape(2, -1)
    grey = 128 + offset + gain * (texture(u, v, seed) - 128).reshape(WINDOW, WINDOW)
    return np.round(grey).astype(np.uint8)


def align(
    windows: list[np.ndarray], warps: list[np.ndarray], starts: list[int], references: list[int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Moves, correlations and warps after alignment of observations at the centres of windows."""
    count = len(windows)
    moves, likeness = np.full((count, 2), 7.0), np.full(count, 7.0)
    matrices = np.array(warps, np.float64)
    launch(
        align_tracks, np.array(windows), np.full((count, 2), CENTRE), matrices, np.array(starts),
        np.array(references), patch_weights(), moves, likeness, items=len(references),
    )  # fmt: skip
    return moves, likeness, matrices


def turned(angle: float, scale: float, shear: float = 0.0) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return scale * np.array([[c, -s], [s, c]]) @ np.array([[1.0, shear], [0.0, 1.0]])


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 1000),
    angle=st.floats(-3.1, 3.1),
    scale=st.floats(0.8, 1.3),
    shear=st.floats(-0.2, 0.2),
    x=st.floats(-1.2, 1.2),
    y=st.floats(-1.2, 1.2),
    gain=st.floats(0.6, 1.3),
    offset=st.floats(-20, 20),
)
def test_an_observation_moves_to_what_the_reference_shows(
    seed: int, angle: float, scale: float, shear: float, x: float, y: float, gain: float, offset: float
) -> None:
    right, place = turned(angle, scale, shear), np.array([x, y])
    windows = [
        window(np.eye(2), np.zeros(2), seed),
        window(right, place, seed, gain, offset),
        window(right, -place, seed),
    ]
    moves, likeness, _ = align(windows, [np.eye(2), right, right], [0, 3], [0])
    assert (likeness > 0.85).all()
    assert np.array_equal(moves[0], [0, 0])
    assert np.allclose(moves[1:], [place, -place], atol=0.12)


def test_affine_warps_that_the_cameras_do_not_know_are_found() -> None:
    right = turned(0.0, 1.0, 0.15)
    shown = window(right, np.array([0.6, -0.4]), 3)
    reference = window(np.eye(2), np.zeros(2), 3)
    moves, likeness, warps = align([reference, shown, shown], [np.eye(2)] * 3, [0, 3], [0])
    assert likeness[1] > 0.95
    assert np.allclose(moves[1], [0.6, -0.4], atol=0.08)
    assert np.linalg.norm(warps[1] - right) < 0.5 * np.linalg.norm(np.eye(2) - right)


def test_what_shows_something_else_is_not_aligned_and_does_not_disturb() -> None:
    place = np.array([0.5, 0.7])
    good = [window(np.eye(2), np.zeros(2), 5), window(np.eye(2), place, 5), window(np.eye(2), place, 5)]
    moves, likeness, _ = align([*good, window(np.eye(2), place, 99)], [np.eye(2)] * 4, [0, 4], [0])
    assert likeness[3] == -1
    assert (likeness[:3] > 0.9).all()
    assert np.allclose(moves[1:3], place, atol=0.05)


@pytest.mark.parametrize("other", ["flat", "unlike", "far", "no warp"])
def test_a_reference_that_nothing_fits_is_not_aligned_either(other: str) -> None:
    reference, warp = window(np.eye(2), np.zeros(2), 5), np.eye(2)
    shown = {
        "flat": np.full((WINDOW, WINDOW), 90, np.uint8),
        "unlike": window(np.eye(2), np.zeros(2), 77),
        "far": window(np.eye(2), np.array([FARTHEST + 1.5, 0.0]), 5),
        "no warp": reference,
    }[other]
    if other == "no warp":
        warp = np.zeros((2, 2))
    moves, likeness, _ = align([reference, shown], [np.eye(2), warp], [0, 2], [0])
    assert (likeness == -1).all()
    assert np.isfinite(moves).all()


def test_patches_that_leave_their_window_are_not_aligned() -> None:
    reference = window(np.eye(2), np.zeros(2), 5)
    _, likeness, _ = align([reference, reference], [np.eye(2), 4 * np.eye(2)], [0, 2], [0])
    assert (likeness == -1).all()


def test_points_do_not_depend_on_each_other_or_on_threads() -> None:
    place = np.array([0.4, -0.6])
    windows, starts, references = [], [0], []
    for seed in range(12):
        references.append(len(windows))
        windows += [window(np.eye(2), np.zeros(2), seed), window(np.eye(2), place, seed)]
        starts.append(len(windows))
    warps = [np.eye(2)] * len(windows)
    with kernels_limited(3):
        moves, likeness, _ = align(windows, warps, starts, references)
    for row in range(0, len(windows), 2):
        alone = align(windows[row : row + 2], warps[:2], [0, 2], [0])
        assert np.array_equal(alone[0], moves[row : row + 2])
        assert np.array_equal(alone[1], likeness[row : row + 2])
