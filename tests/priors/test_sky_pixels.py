"""Sky is found where a photo is smooth, above the horizon, and free of sparse points."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from wildgs.geometry.camera import Camera
from wildgs.priors.sky_pixels import find_sky_pixels

WIDTH, HEIGHT = 160, 120


def camera(pitch: float = 0.0) -> Camera:
    """A camera at the origin that looks along y, `pitch` degrees upwards; z is up."""
    angle = torch.deg2rad(torch.tensor(pitch))
    forward = torch.tensor([0.0, float(angle.cos()), float(angle.sin())])
    right = torch.tensor([1.0, 0.0, 0.0])
    view = torch.eye(4)
    view[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward])
    K = torch.tensor([[120.0, 0, WIDTH / 2], [0, 120.0, HEIGHT / 2], [0, 0, 1]])
    return Camera(view, K, WIDTH, HEIGHT)


def photo(top: float, bottom: float) -> torch.Tensor:
    """Smooth above the middle and noise below it, of the given contrasts."""
    generator = torch.Generator().manual_seed(0)
    noise = torch.rand(HEIGHT, WIDTH, 1, generator=generator) - 0.5
    contrast = torch.where(torch.arange(HEIGHT) < HEIGHT / 2, top, bottom)[:, None, None]
    ramp = torch.linspace(0.5, 0.8, HEIGHT)[:, None, None]
    return ((ramp + contrast * noise).clamp(0, 1) * 255).byte().expand(-1, -1, 3).contiguous()


NO_POINTS = torch.zeros(0, 3)


def test_smooth_pixels_above_the_horizon_are_sky() -> None:
    found = find_sky_pixels(photo(0.02, 0.8), camera(), NO_POINTS)
    assert bool(found[:40].all())
    assert not bool(found[60:].any())


@pytest.mark.parametrize(("contrast", "pitch"), [(0.8, 0.0), (0.02, -60.0)])
def test_foliage_and_what_is_below_the_horizon_are_not(contrast: float, pitch: float) -> None:
    assert not bool(find_sky_pixels(photo(contrast, 0.8), camera(pitch), NO_POINTS).any())


def test_what_carries_points_is_no_sky() -> None:
    """A smooth tower in the middle of the sky, with points of other photos along its edges and within."""
    z, x = torch.meshgrid(torch.linspace(0, 5, 60), torch.linspace(-1, 1, 20), indexing="ij")
    tower = torch.stack([x, torch.full_like(x, 10.0), z], dim=-1).reshape(-1, 3)
    found = find_sky_pixels(photo(0.02, 0.8), camera(), tower)
    assert not bool(found[:, 66:94].any())
    assert bool(found[:30, :50].all())
    assert bool(found[:30, -50:].all())


def test_what_has_a_known_depth_is_no_sky() -> None:
    """A ceiling on the left, of which a depth map tells where it is."""
    known = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    known[:, : WIDTH // 2] = True
    found = find_sky_pixels(photo(0.02, 0.8), camera(), NO_POINTS, known)
    assert not bool(found[:, : WIDTH // 2].any())
    assert bool(found[:40, WIDTH // 2 + 3 :].all())


def test_points_behind_the_camera_do_not_matter() -> None:
    behind = torch.tensor([[0.0, -10.0, 3.0]]).repeat(50, 1) + 0.1 * torch.randn(50, 3)
    plain, same = (find_sky_pixels(photo(0.02, 0.8), camera(), points) for points in (NO_POINTS, behind))
    assert torch.equal(plain, same)


def test_large_photos_are_reduced() -> None:
    large = photo(0.02, 0.8).repeat_interleave(4, 0).repeat_interleave(4, 1)
    found = find_sky_pixels(large, camera().resized(4 * WIDTH, 4 * HEIGHT), NO_POINTS)
    assert found.shape == (HEIGHT, WIDTH)
    assert bool(found[:40].all())


@settings(deadline=None, max_examples=40)
@given(
    width=st.integers(1, 400), height=st.integers(1, 400), value=st.integers(0, 255), count=st.integers(0, 3)
)
def test_photos_of_any_shape_have_a_sky_of_their_shape(
    width: int, height: int, value: int, count: int
) -> None:
    plain = torch.full((height, width, 3), value, dtype=torch.uint8)
    points = torch.tensor([[0.0, 5.0, 1.0]]).repeat(count, 1)
    found = find_sky_pixels(plain, camera().resized(width, height), points)
    scale = min(1.0, 160 / max(width, height))
    assert found.shape == (max(1, round(height * scale)), max(1, round(width * scale)))
