"""Trajectories: smooth, upright, near the photos, with the landmark in view; interpolation passes its stops."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from wildgs.geometry.camera import Camera
from wildgs.geometry.lens import Lens, focal_of, focus, forwards_of, positions_of
from wildgs.geometry.trajectory import interpolate, open_tour, orbit, spiral, spread_out, still, training_path

FRAMES, SIZE = 60, (96, 64)


def ring(degrees: np.ndarray, seed: int = 0) -> list[Camera]:
    """Photographers around the origin at eye height, looking at it more or less, each with a lens of their own."""
    rng = np.random.default_rng(seed)
    cameras = []
    for angle in np.radians(degrees):
        radius = rng.uniform(0.8, 1.2)
        place = np.array([radius * np.cos(angle), radius * np.sin(angle), rng.uniform(-0.02, 0.02)])
        aim = rng.normal(scale=0.05, size=3) + [0, 0, 0.2]
        lens = Lens(rng.uniform(0.8, 1.2), *((60, 40) if rng.random() < 0.5 else (40, 60)))
        cameras.append(lens.camera(place, aim - place))
    return cameras


@pytest.fixture
def points() -> np.ndarray:
    return np.random.default_rng(1).normal(scale=[0.3, 0.2, 0.2], size=(300, 3)) + [0, 0, 0.2]


@pytest.fixture
def facade() -> list[Camera]:
    """Photos of one side only: directions within 100 degrees."""
    return ring(np.random.default_rng(2).uniform(-140, -40, 40))


def turns_of(cameras: list[Camera]) -> np.ndarray:
    """Degrees between the viewing directions of neighbouring frames."""
    forwards = forwards_of(cameras)
    return np.degrees(np.arccos(np.clip((forwards[1:] * forwards[:-1]).sum(axis=1), -1, 1)))


def steps_of(cameras: list[Camera]) -> np.ndarray:
    return np.linalg.norm(np.diff(positions_of(cameras), axis=0), axis=1)


def assert_proper(cameras: list[Camera]) -> None:
    assert len(cameras) == FRAMES
    for camera in cameras:
        rotation = camera.viewmat[:3, :3]
        torch.testing.assert_close(rotation @ rotation.T, torch.eye(3), atol=1e-5, rtol=0)
        assert torch.linalg.det(rotation) > 0.99
        assert (camera.width, camera.height) == SIZE
        assert camera.viewmat.dtype == torch.float32


def assert_upright(cameras: list[Camera]) -> None:
    for camera in cameras:
        assert abs(float(camera.viewmat[0, 2])) < 1e-5  # the picture's x axis is level
        assert float(camera.up[2]) > 0.5


def assert_sees(cameras: list[Camera], target: np.ndarray) -> None:
    """The target lies well within every picture."""
    for camera in cameras:
        seen = camera.viewmat.double().numpy() @ np.append(target, 1)
        pixel = camera.K.double().numpy() @ (seen[:3] / seen[2])
        assert seen[2] > 0
        assert 0.15 * SIZE[0] < pixel[0] < 0.85 * SIZE[0]
        assert 0.15 * SIZE[1] < pixel[1] < 0.85 * SIZE[1]


@pytest.mark.parametrize("make", [orbit, training_path, spiral])
def test_paths_are_smooth_upright_and_look_at_the_landmark(make, facade, points) -> None:
    path = make(facade, points, FRAMES, *SIZE)
    assert_proper(path)
    assert_upright(path)
    assert_sees(path, focus(facade, np.median(points, axis=0)))
    steps, turns = steps_of(path), turns_of(path)
    assert steps.max() < 0.15
    assert turns.max() < 8
    assert np.abs(np.diff(steps)).max() < 0.35 * steps.max()
    assert steps.sum() > 0.3


@pytest.mark.parametrize("make", [orbit, training_path, spiral])
def test_paths_stay_where_photos_were_taken(make, facade, points) -> None:
    places = positions_of(make(facade, points, FRAMES, *SIZE))
    distance = np.linalg.norm(places[:, None] - positions_of(facade)[None], axis=2).min(axis=1)
    assert distance.max() < 0.35
    assert np.abs(places[:, 2]).max() < 0.15


def test_an_orbit_keeps_to_the_side_that_was_photographed(facade, points) -> None:
    places = positions_of(orbit(facade, points, FRAMES, *SIZE))
    directions = np.degrees(np.arctan2(places[:, 1], places[:, 0]))
    assert directions.min() > -145
    assert directions.max() < -35
    assert np.ptp(directions) > 60


def test_an_orbit_closes_where_photos_are_all_around(points) -> None:
    path = orbit(ring(np.arange(0, 360, 12)), points, FRAMES, *SIZE)
    places = positions_of(path)
    directions = np.unwrap(np.arctan2(places[:, 1], places[:, 0]))
    assert np.degrees(np.ptp(directions)) == pytest.approx(360 * (FRAMES - 1) / FRAMES, abs=3)
    assert np.linalg.norm(places[0] - places[-1]) < 2 * steps_of(path).max()


def test_an_orbit_goes_farther_where_photos_were_taken_from_farther(points) -> None:
    near, far = ring(np.arange(-90, 0, 5)), ring(np.arange(0, 90, 5), seed=3)
    far = [
        Lens(focal_of(c), 60, 40).camera(1.5 * c.position.double().numpy(), c.forward.double().numpy())
        for c in far
    ]
    places = positions_of(orbit(near + far, points, FRAMES, *SIZE))
    radius = np.linalg.norm(places[:, :2], axis=1)
    assert radius[places[:, 1] > 0.6].mean() > 1.2 * radius[places[:, 1] < -0.6].mean()


def test_photos_of_something_else_do_not_lead_the_way_astray(facade, points) -> None:
    away = Lens(1.0, 60, 40).camera(np.array([30.0, 0, 0]), np.array([1.0, 0, 0]))
    places = positions_of(training_path([*facade, away, away], points, FRAMES, *SIZE))
    assert np.linalg.norm(places, axis=1).max() < 2


def test_parallel_views_have_a_focus_at_the_points(points) -> None:
    cameras = [
        Lens(1.0, 60, 40).camera(np.array([x, -1.0, 0.2]), np.array([0.0, 1.0, 0.0]))
        for x in np.linspace(-0.2, 0.2, 9)
    ]
    assert np.linalg.norm(focus(cameras, np.median(points, axis=0)) - np.median(points, axis=0)) < 0.3


def test_interpolation_starts_ends_and_passes_at_its_stops(facade) -> None:
    stops = facade[:4]
    path = interpolate(stops, 601, *SIZE)
    for stop, camera in ((stops[0], path[0]), (stops[-1], path[-1])):
        torch.testing.assert_close(camera.viewmat, stop.viewmat, atol=1e-5, rtol=0)
        assert focal_of(camera) == pytest.approx(focal_of(stop), rel=1e-5)
    for stop in stops[1:-1]:
        apart = [
            float((camera.viewmat - stop.viewmat).abs().max()) + abs(focal_of(camera) - focal_of(stop))
            for camera in path
        ]
        assert min(apart) < 0.02


def test_interpolation_has_no_jerks(facade) -> None:
    path = interpolate(facade[:5], 600, *SIZE)
    steps, turns = steps_of(path), turns_of(path)
    assert np.abs(np.diff(steps)).max() < 0.1 * steps.max()
    assert np.abs(np.diff(turns)).max() < 0.1 * turns.max() + 0.05
    assert steps[0] < 0.2 * steps.max()  # it sets out gently


def test_one_stop_and_equal_stops_stand_still(facade) -> None:
    for path in (still(facade[0], 5, *SIZE), interpolate([facade[0]] * 3, 5, *SIZE)):
        assert len(path) == 5
        for camera in path:
            torch.testing.assert_close(camera.viewmat, facade[0].viewmat)


def test_a_single_frame_is_no_special_case(facade, points) -> None:
    for make in (orbit, training_path, spiral):
        assert len(make(facade, points, 1, *SIZE)) == 1
    assert len(interpolate(facade[:2], 1, *SIZE)) == 1


def test_a_single_photo_is_enough(facade, points) -> None:
    for make in (orbit, training_path, spiral):
        assert_proper(make(facade[:1], points, FRAMES, *SIZE))


def test_the_tour_of_a_line_walks_along_it() -> None:
    places = np.random.default_rng(0).permutation(np.arange(9.0))[:, None]
    ordered = places[open_tour(places)][:, 0]
    assert list(ordered) in (sorted(ordered), sorted(ordered, reverse=True))


def test_spread_out_takes_no_place_twice() -> None:
    features = np.array([[0.0], [0.0], [5.0], [5.0], [9.0]])
    assert sorted(features[spread_out(features, 5)][:, 0]) == [0, 5, 9]
