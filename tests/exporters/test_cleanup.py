"""What an export leaves out, and what that costs."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from wildgs.errors import UserError
from wildgs.exporters.splats import CleanupConfig, Splats, agreement, clean, kept_rows
from wildgs.geometry.camera import Camera

POINTS = torch.tensor([[x, y, 0.0] for x in (-1.0, 0.0, 1.0) for y in (-1.0, 0.0, 1.0)])
NOWHERE = torch.zeros(0, 3)


def _camera() -> Camera:
    viewmat = torch.eye(4)
    viewmat[2, 3] = 6.0
    return Camera(viewmat, torch.tensor([[30.0, 0, 16], [0, 30, 12], [0, 0, 1]]), 32, 24)


def test_by_default_everything_stays(splats: Splats) -> None:
    assert not CleanupConfig().active
    assert clean(CleanupConfig(), splats, POINTS, NOWHERE) is splats


def test_faint_ones_go(splats: Splats) -> None:
    keep = kept_rows(CleanupConfig(min_opacity=0.5), splats, POINTS)
    assert torch.equal(keep, splats.opacities >= 0.5)
    assert 0 < keep.sum() < len(keep)


def test_far_ones_go_measured_from_the_points_middle(splats: Splats) -> None:
    shifted = replace(splats, means=splats.means + 10)
    keep = kept_rows(CleanupConfig(max_distance=2.0), shifted, POINTS + 10)
    assert torch.equal(keep, splats.means.norm(dim=1) <= 2.0)


def test_the_crop_keeps_the_points_box(splats: Splats) -> None:
    thick = torch.cat([POINTS + torch.tensor([0.0, 0, z]) for z in (-1.0, 0.0, 1.0)])
    keep = kept_rows(CleanupConfig(crop=1.0), splats, thick)
    assert torch.equal(keep, (splats.means.abs() <= 1).all(dim=1))
    wide = kept_rows(CleanupConfig(crop=2.0), splats, thick)
    assert torch.equal(wide, (splats.means.abs() <= 2).all(dim=1))


def test_the_sky_can_be_left_out_where_it_is_known(splats: Splats) -> None:
    sky = torch.arange(len(splats)) % 3 == 0
    below = clean(CleanupConfig(drop_sky=True), replace(splats, sky=sky), POINTS, NOWHERE)
    assert torch.equal(below.means, splats.means[~sky])
    assert below.sky is not None
    assert not below.sky.any()
    with pytest.raises(UserError, match="--drop-sky"):
        clean(CleanupConfig(drop_sky=True), splats, POINTS, NOWHERE)


def test_harmonics_are_cut_to_the_degree(splats: Splats) -> None:
    cut = clean(CleanupConfig(sh_degree=1), splats, POINTS, torch.tensor([[0.0, 0, -6]]))
    assert cut.sh.shape == (len(splats), 4, 3)
    assert clean(CleanupConfig(sh_degree=3), splats, POINTS, NOWHERE).sh_degree == 3


def test_the_cost_grows_with_what_is_left_out(splats: Splats) -> None:
    cameras = [_camera()]
    assert math.isinf(agreement(splats, splats, cameras))
    costs = [
        agreement(splats, clean(CleanupConfig(min_opacity=least), splats, POINTS, NOWHERE), cameras)
        for least in (0.3, 0.7)
    ]
    assert 60 > costs[0] > costs[1] > 5
