from __future__ import annotations

import torch
from hypothesis import given
from hypothesis import strategies as st

from wildgs.geometry.morton import MAX_BITS, _spread, morton_order


@given(st.integers(0, 2**MAX_BITS - 1))
def test_bits_are_spread(number: int):
    wanted = sum(((number >> bit) & 1) << (3 * bit) for bit in range(MAX_BITS))
    assert int(_spread(torch.tensor(number))) == wanted


def test_corners_of_a_cube_come_in_the_curves_order():
    corners = torch.tensor([[x, y, z] for z in (0.0, 1.0) for y in (0.0, 1.0) for x in (0.0, 1.0)])
    shuffled = torch.tensor([6, 1, 7, 0, 3, 5, 2, 4])
    assert torch.equal(shuffled[morton_order(corners[shuffled])], torch.arange(8))


def test_neighbours_come_near_each_other():
    points = torch.rand(20_000, 3, generator=torch.Generator().manual_seed(0))
    order = morton_order(points)
    assert torch.equal(order.sort().values, torch.arange(len(points)))
    steps = (points[order].diff(dim=0)).norm(dim=1)
    # At random two points of the cube are 0.66 apart; in one of 20,000 cells 0.04.
    assert steps.median() < 0.06


def test_outliers_equal_points_and_no_numbers_do_no_harm():
    points = torch.zeros(50, 3)
    points[3], points[7], points[9] = 1e30, float("nan"), float("inf")
    assert torch.equal(morton_order(points).sort().values, torch.arange(50))
    assert len(morton_order(torch.zeros(0, 3))) == 0
