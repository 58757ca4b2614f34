"""A wall seen by five photos, of which SfM knows the upper half only; a passer-by stands before it in one photo."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.memory_views import make_view, with_photos
from wildgs.geometry.camera import Camera
from wildgs.priors.depth_points import (
    DepthPointsConfig,
    aligned_depth,
    depth_points,
    fit_disparity,
    known_depth,
)
from wildgs.scene import Alignment, Scene, View

SIDE, WALL = 64, 2.0
CONFIG = DepthPointsConfig(cell=0.1)


def camera(index: int) -> Camera:
    viewmat = torch.eye(4)
    viewmat[0, 3] = 0.1 * (index - 2)
    K = torch.tensor([[60.0, 0, SIDE / 2], [0, 60.0, SIDE / 2], [0, 0, 1]])
    return Camera(viewmat, K, SIDE, SIDE)


def view(index: int, depth: torch.Tensor, mask: torch.Tensor | None = None) -> View:
    scale, shift = 0.3 + 0.2 * index, 0.1 * index
    photo = torch.full((SIDE, SIDE, 3), 10 * index, dtype=torch.uint8)
    return make_view(
        f"{index}.png", camera(index), "train", photo, mask=mask, disparity=scale / depth + shift
    )


def relief() -> torch.Tensor:
    """Depth of the wall: the upper half leans back, so that it tells the scale of a disparity."""
    depth = torch.full((SIDE, SIDE), WALL)
    depth[: SIDE // 2] += 0.5 * torch.linspace(1, 0, SIDE // 2)[:, None]
    return depth


def scene(views: list[View] | None = None) -> Scene:
    if views is None:
        views = [view(index, relief()) for index in range(5)]
    known = camera(2).unproject(relief())[: SIDE // 2 : 2, ::2].reshape(-1, 3)
    colors = torch.zeros(len(known), 3, dtype=torch.uint8)
    return Scene(Path("wall"), tuple(views), known, colors, Alignment.identity())


def test_the_wall_is_filled_where_sfm_has_nothing() -> None:
    points, colors = depth_points(scene(), CONFIG)
    lower = points[:, 1] > 0.05
    assert lower.sum() > 50
    assert (points[lower, 2] - WALL).abs().max() < 0.02
    assert points[:, 1].max() > 0.9
    assert ((colors.float() - 20).abs() <= 10).all()


def test_what_sfm_knows_is_not_doubled() -> None:
    known = scene()
    points, _ = depth_points(known, CONFIG)
    cells = {tuple(c) for c in (known.points / CONFIG.cell).floor().long().tolist()}
    assert not cells & {tuple(c) for c in (points / CONFIG.cell).floor().long().tolist()}


def test_who_passes_by_in_one_photo_is_left_out() -> None:
    passed = relief()
    passed[40:60, 20:44] = 1.0
    views = [view(index, passed if index == 2 else relief()) for index in range(5)]
    assert (depth_points(scene(views), CONFIG)[0][:, 2] > 1.9).all()
    alone = replace(CONFIG, support=1, agreement=0.0)
    assert (depth_points(scene(views), alone)[0][:, 2] < 1.1).any(), "this is what would have stood there"


def test_what_three_photos_show_and_more_see_through_is_left_out() -> None:
    """A coach that stood there for three photos of nine."""
    stood = relief()
    stood[40:60, 20:44] = 1.0
    nine = [view(2, stood)] * 3 + [view(index % 5, relief()) for index in range(6)]
    strict = replace(CONFIG, agreement=0.6)
    assert (depth_points(scene(nine), strict)[0][:, 2] > 1.9).all()
    assert (depth_points(scene(nine), replace(CONFIG, agreement=0.0))[0][:, 2] < 1.1).any()


def test_a_users_mask_is_heeded() -> None:
    mask = torch.full((SIDE, SIDE), 255, dtype=torch.uint8)
    mask[SIDE // 2 :] = 0
    views = [view(index, relief(), mask) for index in range(5)]
    points, _ = depth_points(scene(views), CONFIG)
    assert not (points[:, 1] > 0.2).any()


def test_no_more_points_than_asked_for_and_the_same_ones_again() -> None:
    few = replace(CONFIG, points=17)
    points, colors = depth_points(scene(), few)
    assert len(points) == len(colors) == 17
    torch.testing.assert_close(depth_points(scene(), few)[0], points, rtol=0, atol=0)


@pytest.mark.parametrize("config", [CONFIG, replace(CONFIG, points=0)])
def test_without_depth_priors_or_use_for_them_there_are_none(config: DepthPointsConfig) -> None:
    views = [with_photos(each, disparity=None) if config.points else each for each in scene().views]
    points, colors = depth_points(scene(views), config)
    assert points.shape == colors.shape == (0, 3)


def test_depth_is_known_where_a_map_tells_it() -> None:
    """From either kind of map; disparity of 0 means no estimate, as does what lies beyond all points."""
    disparity = (0.3 / relief()).numpy()
    disparity[:8], disparity[-8:] = 0, 0.3 / 50
    codes = (disparity / disparity.max() * 65535).astype(np.uint16)
    metric = np.zeros((SIDE, SIDE), np.float32)
    metric[:4] = 1.0
    made = scene()
    photo = with_photos(made.views[0], disparity=codes, depth=metric)
    known = known_depth(aligned_depth(made, photo, torch.Generator()))
    assert known is not None
    expected = torch.ones(SIDE, SIDE, dtype=torch.bool)
    expected[4:8], expected[-8:] = False, False
    assert torch.equal(known, expected)
    assert known_depth([None, None]) is None


def test_disparity_that_is_noise_is_passed_over() -> None:
    noise = torch.rand(SIDE, SIDE, generator=torch.Generator().manual_seed(0)) + 0.1
    codes = (noise / noise.max() * 65535).numpy().astype(np.uint16)
    views = [with_photos(each, disparity=codes) for each in scene().views]
    assert len(depth_points(scene(views), CONFIG)[0]) == 0


@given(
    scale=st.floats(0.01, 100), shift=st.floats(-5, 5), outliers=st.floats(0, 0.5), seed=st.integers(0, 2**31)
)
def test_the_fit_finds_scale_and_shift_among_outliers(
    scale: float, shift: float, outliers: float, seed: int
) -> None:
    generator = torch.Generator().manual_seed(seed)
    inverse = torch.rand(200, generator=generator) + 0.2
    disparity = (inverse - shift) / scale
    wrong = torch.rand(200, generator=generator) < outliers
    measured = torch.where(wrong, inverse * (0.3 + 0.5 * torch.rand(200, generator=generator)), inverse)
    fit = fit_disparity(disparity, measured, generator)
    assert fit is not None
    torch.testing.assert_close(fit[0] * disparity + fit[1], inverse, rtol=0.04, atol=0.0)


def test_far_that_is_large_is_no_disparity() -> None:
    inverse = torch.linspace(0.2, 1, 100)
    assert fit_disparity(1 - inverse, inverse, torch.Generator().manual_seed(0)) is None


def test_metric_depth_of_two_photos_is_enough_and_brings_their_disparity_to_scale() -> None:
    depth = relief()
    metric = depth.clone()
    metric[:, SIDE // 2 :] = 0
    two = [with_photos(view(index, depth), disparity=None, depth=metric.numpy()) for index in (2, 3)]
    assert len(depth_points(scene(two[:1]), CONFIG)[0]) == 0
    points, _ = depth_points(scene(two), CONFIG)
    assert len(points) > 100
    assert points[:, 0].max() < 0.1
    assert (points[points[:, 1] > 0.05, 2] - WALL).abs().max() < 0.02
    several = [with_photos(view(index, depth), depth=metric.numpy()) for index in range(5)]
    filled, _ = depth_points(scene(several), CONFIG)
    right = filled[(filled[:, 0] > 0.1) & (filled[:, 1] > 0.05)]
    assert len(right) > 20
    assert (right[:, 2] - WALL).abs().max() < 0.05


def test_disparity_is_aligned_to_what_the_photo_observes() -> None:
    """Points of the other side of the building project into the photo, too."""
    made = scene()
    behind = torch.rand(4 * len(made.points), 3, generator=torch.Generator().manual_seed(0))
    behind = (behind - 0.5) * torch.tensor([2.0, 1.0, 6.0]) + torch.tensor([0.0, -0.5, 6.0])
    mixed = replace(
        made,
        points=torch.cat([made.points, behind]),
        point_colors=torch.zeros(5 * len(made.points), 3, dtype=torch.uint8),
    )
    assert aligned_depth(mixed, made.views[0], torch.Generator())[1] is None
    count = len(made.points)
    rows = torch.stack([torch.zeros(count), torch.arange(count)], dim=1).int()
    aligned = aligned_depth(replace(mixed, observations=rows), made.views[0], torch.Generator())[1]
    assert aligned is not None
    known = aligned > 0  # not beyond nearly all of the points
    assert known.float().mean() > 0.9
    torch.testing.assert_close(aligned[known], relief()[known], rtol=0.02, atol=0)
