"""Weights of pixels by structure: other light changes nothing, other things do."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from wildgs.model.likeness import LEAST, likeness
from wildgs.rasterize import TILE

HEIGHT, WIDTH = 90, 120


def columns() -> Tensor:
    """A façade: columns of two greys."""
    grey = torch.where(torch.arange(WIDTH) // 4 % 2 == 0, 0.7, 0.4)
    return grey[None, :, None].expand(HEIGHT, WIDTH, 3).clone()


def with_coach(photo: Tensor) -> Tensor:
    photo = photo.clone()
    photo[40:80, 30:100] = torch.tensor([0.2, 0.6, 0.2])
    return photo


def sample(every: int = 3) -> tuple[Tensor, Tensor]:
    rows, across = torch.meshgrid(
        torch.arange(1, HEIGHT, every), torch.arange(1, WIDTH, every), indexing="ij"
    )
    return rows.flatten(), across.flatten()


def weights(photo: Tensor, render: Tensor, *, sampled: bool) -> tuple[Tensor, Tensor, Tensor]:
    """Rows and columns, and weights there."""
    if sampled:
        pixels = sample()
        return *pixels, likeness(photo[pixels], render[pixels], pixels, HEIGHT, WIDTH)
    rows, across = torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij")
    return rows, across, likeness(photo, render, None, HEIGHT, WIDTH)


@pytest.mark.parametrize("sampled", [False, True])
def test_other_light_has_the_same_structure(sampled: bool) -> None:
    evening = (columns() * torch.tensor([0.9, 0.6, 0.4]) + 0.05).clamp(0, 1)
    assert weights(evening, columns(), sampled=sampled)[2].min() > 0.99


@pytest.mark.parametrize("sampled", [False, True])
def test_a_coach_before_a_facade_has_another(sampled: bool) -> None:
    rows, across, found = weights(with_coach(columns()), columns(), sampled=sampled)
    inside = (rows >= 48) & (rows < 64) & (across >= 48) & (across < 80)
    outside = (rows < 32) | (across >= 112)
    assert found[inside].max() < LEAST + 0.07
    assert found[outside].min() > 0.99


@pytest.mark.parametrize("sampled", [False, True])
def test_flat_areas_are_alike_whatever_their_colour(sampled: bool) -> None:
    wall = torch.full((HEIGHT, WIDTH, 3), 0.5)
    assert weights(0.5 * wall, wall, sampled=sampled)[2].min() > 0.99


@pytest.mark.parametrize("sampled", [False, True])
def test_weights_are_between_the_least_and_one(sampled: bool) -> None:
    drawn = torch.rand(2, HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(0))
    found = weights(drawn[0], drawn[1], sampled=sampled)[2]
    assert float(found.min()) == pytest.approx(LEAST)
    assert float(found.max()) <= 1


def test_tiles_are_those_of_the_rasteriser() -> None:
    photo = columns()
    photo[TILE : 2 * TILE, TILE : 2 * TILE] = 0.5
    rows, across, found = weights(photo, columns(), sampled=True)
    changed = (rows // TILE == 1) & (across // TILE == 1)
    assert found[changed].max() < LEAST + 0.1
    assert found[~changed].min() > 0.99


def test_rounding_of_bright_photos_is_no_structure() -> None:
    noise = torch.rand(HEIGHT, WIDTH, 1, generator=torch.Generator().manual_seed(0)) / 255
    assert (
        weights((0.9 + noise).expand(-1, -1, 3), torch.full((HEIGHT, WIDTH, 3), 0.9), sampled=True)[2].min()
        > 0.9
    )
