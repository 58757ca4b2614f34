"""The ground is the clearest level layer of points below the cameras, or nothing."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.priors.test_ground import cameras, paving, wall
from wildgs.priors.ground_plane import find_ground, ground_plane, height_at, heights_above


@settings(max_examples=15, deadline=None)
@given(slope=st.tuples(st.floats(-0.07, 0.07), st.floats(-0.07, 0.07)), seed=st.integers(0, 1000))
def test_the_plane_is_found_among_walls(slope: tuple[float, float], seed: int) -> None:
    points = torch.cat([paving(slope, noise=0.01, seed=seed), wall()])
    plane = find_ground(points, cameras())
    assert plane is not None
    torch.testing.assert_close(plane, torch.tensor([*slope, -0.5]), atol=0.02, rtol=0)


def test_depth_maps_count_only_where_sfm_found_no_ground() -> None:
    lower = paving() - torch.tensor([0.0, 0.0, 0.1])

    def never() -> torch.Tensor:
        raise AssertionError

    plane = ground_plane(torch.cat([paving(), wall()]), never, cameras())
    assert plane is not None
    torch.testing.assert_close(plane, torch.tensor([0.0, 0.0, -0.5]), atol=0.01, rtol=0)
    plane = ground_plane(wall(), lambda: torch.cat([wall(), lower]), cameras())
    assert plane is not None
    torch.testing.assert_close(plane, torch.tensor([0.0, 0.0, -0.6]), atol=0.01, rtol=0)
    assert ground_plane(wall(), wall, cameras()) is None


def test_stairs_with_most_of_the_points_do_not_raise_the_plane() -> None:
    """To cameras at eye height, a plane tilted by a flight of stairs is the wrong ground."""
    x, y = torch.rand(2, 6000, generator=torch.Generator().manual_seed(0))
    stairs = torch.stack([1.6 * x - 0.8, 1.0 + 0.6 * y, 0.02 * (4 * y).floor() - 0.49], dim=1)
    ground = paving(noise=0.001)[:500]
    eyes = torch.stack([torch.linspace(-1, 1, 9), torch.full((9,), -1.0), torch.full((9,), -0.43)], dim=1)
    plane = find_ground(torch.cat([ground, stairs]), eyes)
    assert plane is not None
    feet = torch.cat([eyes[:, :2], torch.ones(9, 1)], dim=1) @ plane
    torch.testing.assert_close(feet, torch.full((9,), -0.5), atol=0.002, rtol=0)


def eyes(height: float, count: int = 20, seed: int = 0) -> torch.Tensor:
    """Photographers around the origin, whose cameras are at about the same height above z = -0.5."""
    generator = torch.Generator().manual_seed(seed)
    places = 2 * torch.rand(count, 2, generator=generator) - 1
    above = height * (0.9 + 0.2 * torch.rand(count, 1, generator=generator))
    return torch.cat([places, above - 0.5], dim=1)


@settings(max_examples=10, deadline=None)
@given(height=st.floats(0.03, 0.6), seed=st.integers(0, 1000))
def test_it_is_found_at_any_height(height: float, seed: int) -> None:
    centers = eyes(height, seed=seed)
    points = torch.cat([paving(noise=0.01 * height, seed=seed), wall()])
    plane = find_ground(points, centers)
    assert plane is not None
    errors = heights_above(plane, centers) - (centers[:, 2] + 0.5)
    assert float(errors.abs().max()) < 0.05 * height


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("count", "height"), [(300, 0.03), (1500, 0.1), (4000, 0.3)])
def test_walls_and_trees_are_no_ground(seed: int, count: int, height: float) -> None:
    """Nothing level, however many points are below the cameras."""
    tree = torch.randn(count, 3, generator=torch.Generator().manual_seed(seed)) * torch.tensor(
        [1.0, 1.0, 0.2]
    )
    assert find_ground(tree - torch.tensor([0.0, 0.0, 0.5]), eyes(height, seed=seed)) is None
    assert find_ground(wall(), eyes(height, seed=seed)) is None


def test_what_is_at_some_photographers_eyes_is_no_ground() -> None:
    """The top of a wall, level and full of points, below most cameras and close to others."""
    centers = eyes(0.1)
    centers[::3, 2] -= 0.07
    top = paving() + torch.tensor([0.0, 0.0, 0.02])
    assert find_ground(top, centers) is None
    assert find_ground(top - torch.tensor([0.0, 0.0, 0.02]), eyes(0.1)) is not None


def test_a_ledge_is_no_ground() -> None:
    """A level line on a wall, on which more points are than on all paving."""
    along = torch.rand(1000, generator=torch.Generator().manual_seed(0))
    ledge = torch.stack([2 * along - 1, torch.full_like(along, 1.2), torch.full_like(along, -0.45)], dim=1)
    higher = wall()[wall()[:, 2] > -0.4]
    assert find_ground(torch.cat([ledge, higher]), eyes(0.1)) is None
    few = paving(noise=0.001)[:300]
    plane = find_ground(torch.cat([ledge, few, wall()]), eyes(0.1))
    assert plane is not None
    assert float(height_at(plane, torch.zeros(2))) == pytest.approx(-0.5, abs=0.005)


def test_most_cameras_may_be_higher() -> None:
    """Photos from windows and hills beside those from the street."""
    centers = torch.cat([eyes(0.1), eyes(0.1, 30, seed=1) + torch.tensor([0.0, 0.0, 0.5])])
    plane = find_ground(torch.cat([paving(noise=0.002), wall()]), centers)
    assert plane is not None
    assert float(height_at(plane, torch.zeros(2))) == pytest.approx(-0.5, abs=0.005)


@pytest.mark.parametrize("count", [0, 1, 19])
def test_too_few_points_and_no_camera(count: int) -> None:
    assert find_ground(paving()[:count], cameras()) is None
    assert find_ground(paving(), torch.zeros(0, 3)) is None
