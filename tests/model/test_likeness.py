"""Weights of sampled pixels: only what differs in colour and in structure does not tell the light."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from wildgs.model.likeness import LEAST, likeness

HEIGHT, WIDTH, SIDE, EVERY = 96, 128, 16, 3
ROWS, ACROSS = (
    each.flatten()
    for each in torch.meshgrid(torch.arange(1, HEIGHT, EVERY), torch.arange(1, WIDTH, EVERY), indexing="ij")
)
TILES, COUNT = ROWS // SIDE * (WIDTH // SIDE) + ACROSS // SIDE, HEIGHT * WIDTH // SIDE**2
COACH = (ROWS >= 48) & (ROWS < 80) & (ACROSS >= 32) & (ACROSS < 96)
EVENING = torch.tensor([0.9, 0.6, 0.4])


def facade() -> Tensor:
    """Columns of two greys."""
    grey = torch.where(ACROSS // 4 % 2 == 0, 0.7, 0.4)
    return grey[:, None].expand(-1, 3).clone()


def weights(photo: Tensor, render: Tensor, base: Tensor | None = None) -> Tensor:
    return likeness(photo, render, torch.ones(len(photo)) if base is None else base, TILES, COUNT)


def with_coach(photo: Tensor, color: tuple[float, float, float] = (0.1, 0.6, 0.2)) -> Tensor:
    return torch.where(COACH[:, None], torch.tensor(color), photo)


def test_other_light_counts_fully() -> None:
    assert weights(facade() * EVENING + 0.05, facade()).min() > 0.99
    floodlit = facade() * torch.where(ROWS < 40, 1.0, 0.3)[:, None] * EVENING
    assert weights(floodlit, facade()).min() > 0.98, "light that varies over the landmark"


@pytest.mark.parametrize("light", [torch.ones(3), EVENING])
def test_a_coach_hardly_counts(light: Tensor) -> None:
    found = weights(with_coach(facade() * light), facade())
    assert found[COACH].max() < 0.3
    assert found[~COACH].min() > 0.99


def test_foliage_of_the_usual_colour_counts() -> None:
    """Leaves of one photo are elsewhere in another."""
    leaves = torch.rand(2, len(ROWS), 1, generator=torch.Generator().manual_seed(0))
    tree = torch.tensor([0.2, 0.5, 0.1]) * (0.6 + 0.8 * leaves)
    photo, render = (torch.where(COACH[:, None], each, facade()) for each in tree)
    assert weights(photo * EVENING, render).min() > 0.8


def test_flat_walls_count_whatever_their_colour() -> None:
    wall = torch.full((len(ROWS), 3), 0.5)
    assert weights(with_coach(wall), wall).min() > 0.99


def test_pixels_without_weight_do_not_matter() -> None:
    base = torch.ones(len(ROWS))
    base[ACROSS >= 104] = 0
    photo = with_coach(facade() * EVENING)
    other = torch.where((base == 0)[:, None], 1 - photo, photo)
    torch.testing.assert_close(weights(photo, facade(), base), weights(other, facade(), base), rtol=0, atol=0)


def test_weights_are_between_the_least_and_one() -> None:
    drawn = torch.rand(2, len(ROWS), 3, generator=torch.Generator().manual_seed(0))
    found = weights(with_coach(drawn[0], (1.0, 0.0, 0.0)), drawn[1])
    assert found.min() >= LEAST
    assert found.max() <= 1
    assert weights(drawn[0], drawn[1], torch.zeros(len(ROWS))).isfinite().all()
