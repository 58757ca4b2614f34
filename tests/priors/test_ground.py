"""A square of paving with a hole, a wall behind it, and cameras around: the hole is filled, and only that."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import KDTree

from wildgs.priors.ground import GroundConfig, find_ground, ground_plane, ground_points

CONFIG = GroundConfig(spacing=0.1)


def paving(slope: tuple[float, float] = (0.0, 0.0), noise: float = 0.0, seed: int = 0) -> torch.Tensor:
    """Points on the ground z = slope . (x, y) - 0.5 over [-2, 2]², without those within 0.6 of the origin."""
    generator = torch.Generator().manual_seed(seed)
    places = 4 * torch.rand(4000, 2, generator=generator) - 2
    places = places[places.norm(dim=1) > 0.6]
    heights = places @ torch.tensor(slope) - 0.5 + noise * torch.randn(len(places), generator=generator)
    return torch.cat([places, heights[:, None]], dim=1)


def wall(count: int = 3000) -> torch.Tensor:
    generator = torch.Generator().manual_seed(1)
    y, z = torch.rand(2, count, generator=generator)
    return torch.stack([torch.full_like(y, 2.2), 4 * y - 2, 2 * z - 0.5], dim=1)


def cameras() -> torch.Tensor:
    turn = torch.linspace(0, 6, 9)
    return torch.stack([0.5 * turn.cos(), 0.5 * turn.sin(), torch.zeros(9)], dim=1)


def grey(points: torch.Tensor, value: int = 90) -> torch.Tensor:
    return torch.full((len(points), 3), value, dtype=torch.uint8)


@settings(max_examples=15, deadline=None)
@given(slope=st.tuples(st.floats(-0.1, 0.1), st.floats(-0.1, 0.1)), seed=st.integers(0, 1000))
def test_the_plane_is_found_among_walls(slope: tuple[float, float], seed: int) -> None:
    points = torch.cat([paving(slope, noise=0.01), wall()])
    plane = find_ground(points, cameras(), 0.03, torch.Generator().manual_seed(seed))
    assert plane is not None
    torch.testing.assert_close(plane, torch.tensor([*slope, -0.5]), atol=0.02, rtol=0)


def test_depth_maps_count_only_where_sfm_found_no_ground() -> None:
    lower = paving() - torch.tensor([0.0, 0.0, 0.1])

    def never() -> torch.Tensor:
        raise AssertionError

    plane = ground_plane(torch.cat([paving(), wall()]), never, cameras(), 0.03)
    assert plane is not None
    torch.testing.assert_close(plane, torch.tensor([0.0, 0.0, -0.5]), atol=0.01, rtol=0)
    plane = ground_plane(wall(), lambda: torch.cat([wall(), lower]), cameras(), 0.03)
    assert plane is not None
    torch.testing.assert_close(plane, torch.tensor([0.0, 0.0, -0.6]), atol=0.01, rtol=0)
    assert ground_plane(wall(), wall, cameras(), 0.03) is None


def test_the_hole_is_filled_and_what_is_known_is_not_doubled() -> None:
    known = paving()
    points = torch.cat([known, wall()])
    colors = torch.cat([grey(known), grey(wall(), 200)])
    filled, painted = ground_points(points, colors, cameras(), CONFIG)
    middle = filled[filled[:, :2].norm(dim=1) < 0.45]
    assert len(middle) > 0.8 * 3.14 * 0.45**2 / CONFIG.spacing**2
    torch.testing.assert_close(filled[:, 2], torch.full_like(filled[:, 2], -0.5), atol=0.01, rtol=0)
    assert float(torch.cdist(filled[:, :2], known[:, :2]).min()) > CONFIG.spacing
    assert (painted == 90).all()


def test_the_budget_goes_to_what_is_nearest_to_the_cameras() -> None:
    known = paving()
    everything, _ = ground_points(known, grey(known), cameras(), CONFIG)
    few, _ = ground_points(known, grey(known), cameras(), GroundConfig(spacing=0.1, points=10))
    assert len(few) == 10 < len(everything)
    assert torch.equal(few, everything[:10])


@pytest.mark.parametrize(
    ("points", "centers"),
    [
        (wall(), cameras()),
        (paving(), cameras() - torch.tensor([0.0, 0.0, 2.0])),
        (paving()[:20], cameras()),
        (paving(), torch.zeros(0, 3)),
        (torch.zeros(300, 3) - torch.tensor([0.0, 0.0, 1.0]), cameras()),
        (paving((0.6, 0.0)), cameras() + torch.tensor([0.0, 0.0, 3.0])),
    ],
    ids=["a wall alone", "cameras below", "too few points", "no camera", "one place", "a steep slope"],
)
def test_where_no_ground_shows_there_is_none(points: torch.Tensor, centers: torch.Tensor) -> None:
    filled, colors = ground_points(points, grey(points), centers, CONFIG)
    assert filled.shape == (0, 3)
    assert colors.shape == (0, 3)
    assert colors.dtype == torch.uint8


def test_none_is_wanted() -> None:
    known = paving()
    assert len(ground_points(known, grey(known), cameras(), GroundConfig(points=0))[0]) == 0


def test_a_stray_camera_asks_for_no_large_grid(monkeypatch) -> None:
    """1,000 units away: the whole grid would have 6 * 10^8 places."""
    points = torch.cat([paving(), wall()])
    colors = torch.cat([grey(paving()), grey(wall(), 200)])
    stray = torch.cat([cameras().repeat(3, 1), torch.tensor([[1000.0, 1000.0, 0.0]])])
    config = GroundConfig(spacing=0.04)
    largest = 0
    query = KDTree.query

    def counted(tree, places, *arguments, **options):
        nonlocal largest
        largest = max(largest, len(places))
        return query(tree, places, *arguments, **options)

    monkeypatch.setattr(KDTree, "query", counted)
    filled, _ = ground_points(points, colors, stray, config)
    assert largest <= 2_000_000
    middle = filled[filled[:, :2].norm(dim=1) < 0.45]
    assert len(middle) > 0.8 * 3.14 * 0.45**2 / config.spacing**2


def test_stairs_with_most_of_the_points_do_not_raise_the_plane() -> None:
    """To cameras at eye height, a plane tilted by a flight of stairs is the wrong ground."""
    x, y = torch.rand(2, 6000, generator=torch.Generator().manual_seed(0))
    stairs = torch.stack([1.6 * x - 0.8, 1.0 + 0.6 * y, 0.02 * (4 * y).floor() - 0.49], dim=1)
    ground = paving(noise=0.001)[:500]
    eyes = torch.stack([torch.linspace(-1, 1, 9), torch.full((9,), -1.0), torch.full((9,), -0.43)], dim=1)
    plane = find_ground(torch.cat([ground, stairs]), eyes, 0.03, torch.Generator().manual_seed(0))
    assert plane is not None
    feet = torch.cat([eyes[:, :2], torch.ones(9, 1)], dim=1) @ plane
    torch.testing.assert_close(feet, torch.full((9,), -0.5), atol=0.002, rtol=0)
