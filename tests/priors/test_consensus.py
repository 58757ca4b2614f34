"""Consensus of photos on a textured wall, of which one photo shows something else in places."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from wildgs.geometry.camera import Camera
from wildgs.priors.consensus import (
    LEAST_PHOTOS,
    consensus,
    doubts,
    nearest_depth,
    principal_directions,
    reduced,
)

ROWS, COLUMNS, CHANNELS = 18, 24, 16
DEPTH = 4.0
PLACES = torch.rand(200, 3, generator=torch.Generator().manual_seed(3)) + torch.tensor([-0.5, -0.5, 3.5])


def camera_at(x: float) -> Camera:
    viewmat = torch.eye(4)
    viewmat[0, 3] = -x
    return Camera(viewmat, torch.tensor([[240.0, 0, 120], [0, 240, 90], [0, 0, 1]]), 240, 180)


def wall_features(camera: Camera) -> Tensor:
    """Smooth random features of a wall at `DEPTH`, as unit vectors."""
    texture = torch.randn(1, CHANNELS, 40, 40, generator=torch.Generator().manual_seed(1))
    y, x = torch.meshgrid(
        (torch.arange(ROWS) + 0.5) / ROWS, (torch.arange(COLUMNS) + 0.5) / COLUMNS, indexing="ij"
    )
    across = (x * 240 - 120) / 240 * DEPTH - camera.viewmat[0, 3]
    down = (y * 180 - 90) / 240 * DEPTH
    shown = functional.grid_sample(texture, torch.stack([across, down], -1)[None] / 5, align_corners=False)
    return functional.normalize(shown[0], dim=0)


def random_features(seed: int) -> Tensor:
    drawn = torch.randn(CHANNELS, ROWS, COLUMNS, generator=torch.Generator().manual_seed(seed))
    return functional.normalize(drawn, dim=0)


@pytest.fixture
def others() -> list[tuple[Tensor, Camera]]:
    return [(wall_features(camera_at(x)), camera_at(x)) for x in (-0.9, -0.6, -0.3, 0.3, 0.6, 0.9)]


def test_what_all_photos_show_has_consensus_and_what_one_shows_has_not(others) -> None:
    mine = wall_features(camera_at(0.0))
    mine[:, 6:12, 8:14] = random_features(7)[:, 6:12, 8:14]
    found = consensus(mine, camera_at(0.0), others, 1.0)
    strange = torch.zeros(ROWS, COLUMNS, dtype=torch.bool)
    strange[6:12, 8:14] = True
    assert found[~strange].median() > 0.9
    assert found[strange].max() < found[~strange].median() - 0.15
    (doubt,) = doubts([found])
    assert doubt[strange].mean() > doubt[~strange].mean() + 0.1


def test_some_photos_may_show_something_in_front(others) -> None:
    free = consensus(wall_features(camera_at(0.0)), camera_at(0.0), others, 1.0)
    covered = [
        (random_features(k), camera) if k < 4 else (shown, camera) for k, (shown, camera) in enumerate(others)
    ]
    found = consensus(wall_features(camera_at(0.0)), camera_at(0.0), covered, 1.0)
    assert (found[:, 6:18] > free[:, 6:18] - 0.2).float().mean() > 0.9


def test_too_few_photos_have_no_consensus_and_everything_may_be_transient(others) -> None:
    mine = wall_features(camera_at(0.0))
    assert consensus(mine, camera_at(0.0), others[: LEAST_PHOTOS - 1], 1.0).isnan().all()
    away = Camera(torch.diag(torch.tensor([-1.0, 1, -1, 1])), camera_at(0.0).K, 240, 180)  # looks backwards
    assert consensus(mine, away, others, 1.0).isnan().all()
    (doubt,) = doubts([torch.full((3, 4), torch.nan)])
    assert doubt.eq(1).all()
    assert doubts([]) == []


def test_places_outside_of_the_other_photos_have_no_consensus(others) -> None:
    left = [
        (shown, camera_at(x)) for (shown, _), x in zip(others, (2.0, 2.1, 2.2, 2.3, 2.4, 2.5), strict=True)
    ]
    found = consensus(wall_features(camera_at(0.0)), camera_at(0.0), left, 3.9)
    assert not found[:, -1].isnan().any()  # seen at infinity, if nowhere else
    near = [(shown, Camera(turned(40.0), camera.K, 240, 180)) for shown, camera in others]
    assert consensus(wall_features(camera_at(0.0)), camera_at(0.0), near, 3.9)[:, 0].isnan().all()


def turned(degrees: float) -> Tensor:
    angle = torch.tensor(degrees).deg2rad()
    viewmat = torch.eye(4)
    viewmat[0, 0] = viewmat[2, 2] = angle.cos()
    viewmat[0, 2], viewmat[2, 0] = -angle.sin(), angle.sin()
    return viewmat


def test_doubts_fall_with_consensus_relative_to_the_median() -> None:
    found = torch.tensor([[0.1, 0.2, 0.3, 0.4, 0.5, 0.5, 0.5, 0.5, 0.5, 0.9]])
    (doubt,) = doubts([found])
    assert (doubt.diff() <= 0).all()
    assert doubt[0, 0] == 1
    assert doubt[0, -1] == 0
    (same,) = doubts([0.5 * found])
    torch.testing.assert_close(same, doubt)


def test_directions_keep_most_of_the_variance() -> None:
    generator = torch.Generator().manual_seed(0)
    mixed = torch.randn(192, 8, generator=generator) @ torch.randn(8, 6 * 5, generator=generator)
    features = mixed.view(192, 6, 5)
    directions = principal_directions([features, 2 * features])
    assert directions.shape == (192, 48)
    kept = reduced(features, directions)
    torch.testing.assert_close(kept.norm(dim=0), torch.ones(6, 5))
    original = functional.normalize(features, dim=0).flatten(1)
    torch.testing.assert_close(kept.flatten(1).T @ kept.flatten(1), original.T @ original, atol=1e-4, rtol=0)


def test_the_sweep_begins_before_the_nearest_points() -> None:
    nearest = nearest_depth(camera_at(0.0), PLACES)
    assert nearest is not None
    assert 1.5 < nearest < 3.5
    assert nearest_depth(camera_at(0.0), -PLACES) is None
    assert nearest_depth(camera_at(0.0), PLACES[:0]) is None
