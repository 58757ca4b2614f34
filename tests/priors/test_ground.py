"""A square of paving with a hole, a wall behind it, and cameras around: the hole is filled, and only that."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import KDTree

from wildgs.geometry.camera import Camera
from wildgs.priors.config import GroundConfig
from wildgs.priors.ground import GroundPoints, ground_points
from wildgs.priors.ground_plane import ground_plane, heights_above

CONFIG = GroundConfig(spacing=0.1, most_pixels=0.0)


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


def level(centers: torch.Tensor, focal: float = 100.0) -> list[Camera]:
    """Cameras of 100 x 80 pixels that look along +y."""
    turn = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    found = []
    for center in centers:
        viewmat = torch.eye(4)
        viewmat[:3, :3], viewmat[:3, 3] = turn, -turn @ center
        K = torch.tensor([[focal, 0.0, 50.0], [0.0, focal, 40.0], [0.0, 0.0, 1.0]])
        found.append(Camera(viewmat, K, 100, 80))
    return found


def filled(
    points: torch.Tensor, colors: torch.Tensor, centers: torch.Tensor, config: GroundConfig = CONFIG
) -> GroundPoints:
    plane = ground_plane(points, lambda: points, centers) if len(centers) else None
    return ground_points(points, colors, plane, level(centers), config)


def grey(points: torch.Tensor, value: int = 90) -> torch.Tensor:
    return torch.full((len(points), 3), value, dtype=torch.uint8)


def test_the_hole_is_filled_and_what_is_known_is_not_doubled() -> None:
    known = paving()
    points = torch.cat([known, wall()])
    colors = torch.cat([grey(known), grey(wall(), 200)])
    found = filled(points, colors, cameras())
    middle = found.points[found.points[:, :2].norm(dim=1) < 0.45]
    assert len(middle) > 0.8 * 3.14 * 0.45**2 / CONFIG.spacing**2
    assert float((found.points[:, 2] + 0.5).abs().max()) < 0.01
    assert float(torch.cdist(found.points[:, :2], known[:, :2]).min()) > CONFIG.spacing
    assert (found.colors == 90).all()
    assert (found.spacing == CONFIG.spacing).all()


def test_the_budget_goes_to_what_is_nearest_to_the_cameras() -> None:
    known = paving()
    everything = filled(known, grey(known), cameras())
    few = filled(known, grey(known), cameras(), replace(CONFIG, points=10))
    assert len(few) == 10 < len(everything)
    assert torch.equal(few.points, everything.points[:10])


@settings(max_examples=15, deadline=None)
@given(focal=st.floats(40, 400), most=st.floats(4, 30), points=st.integers(1, 20_000))
def test_points_are_denser_where_photos_are_near(focal: float, most: float, points: int) -> None:
    """Cells cover the same area as without, each at most as large in a photo as wanted, if the number allows."""
    known, photos = paving((0.05, 0.0)), level(cameras(), focal)
    plane = ground_plane(known, lambda: known, cameras())
    config = GroundConfig(points=points, spacing=0.1, most_pixels=most)
    found = ground_points(known, grey(known), plane, photos, config)
    even = ground_points(known, grey(known), plane, photos, replace(CONFIG, points=-(-points // 2)))
    assert len(even) <= len(found) <= max(points, len(even))
    area = float(even.spacing.square().sum())
    assert float(found.spacing.square().sum()) == pytest.approx(area, rel=1e-4)
    torch.testing.assert_close(heights_above(plane, found.points), torch.zeros(len(found)), atol=1e-5, rtol=0)
    nearest = torch.full((len(found),), torch.inf)
    for photo in photos:
        places, depths = photo.project(found.points)
        shown = (depths > 0.1) & (places > 0).all(dim=1) & (places < torch.tensor([100, 80])).all(dim=1)
        nearest = torch.where(shown, torch.minimum(nearest, depths), nearest)
    pixels = focal * found.spacing / nearest
    if len(found) + 3 <= points:
        assert float(pixels.max()) <= most * 1.001
    unseen = nearest.isinf() & (torch.cdist(found.points[:, :2], cameras()[:, :2]).min(dim=1).values > 0.8)
    assert (found.spacing[unseen & (found.points[:, 1] < -1.2)] == 0.1).all()


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
    found = filled(points, grey(points), centers)
    assert found.points.shape == found.colors.shape == (0, 3)
    assert found.spacing.shape == (0,)
    assert found.colors.dtype == torch.uint8


def test_none_is_wanted() -> None:
    known = paving()
    assert len(filled(known, grey(known), cameras(), GroundConfig(points=0))) == 0


def test_a_stray_camera_asks_for_no_large_grid(monkeypatch) -> None:
    """1,000 units away: the whole grid would have 6 * 10^8 places."""
    points = torch.cat([paving(), wall()])
    colors = torch.cat([grey(paving()), grey(wall(), 200)])
    stray = torch.cat([cameras().repeat(3, 1), torch.tensor([[1000.0, 1000.0, 0.0]])])
    config = replace(CONFIG, spacing=0.04, points=6000)
    largest = 0
    query = KDTree.query

    def counted(tree, places, *arguments, **options):
        nonlocal largest
        largest = max(largest, len(places))
        return query(tree, places, *arguments, **options)

    monkeypatch.setattr(KDTree, "query", counted)
    found = filled(points, colors, stray, config).points
    assert largest <= 2_000_000
    middle = found[found[:, :2].norm(dim=1) < 0.45]
    assert len(middle) > 0.8 * 3.14 * 0.45**2 / config.spacing**2
