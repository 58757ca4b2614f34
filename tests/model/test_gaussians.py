"""Rows of Gaussians that a view shades."""

from __future__ import annotations

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from wildgs.model.gaussians import ROWS_STEP, rows_by_group, rows_to_shade


@settings(deadline=None, max_examples=40)
@given(count=st.integers(1, 5000), seen=st.floats(0, 1), share=st.floats(0, 1), seed=st.integers(0, 9))
def test_rows_by_group_are_the_visible_ones_in_two_parts(
    count: int, seen: float, share: float, seed: int
) -> None:
    generator = torch.Generator().manual_seed(seed)
    visible = torch.rand(count, generator=generator) < seen
    group = torch.rand(count, generator=generator) < share
    rows, first = rows_by_group(visible, group)
    assert len(rows.unique()) == len(rows)
    assert set(visible.nonzero()[:, 0].tolist()) <= set(rows.tolist())
    assert not bool(group[rows[:first]].any())
    assert bool(group[rows[first:]].all())
    for size, most in ((first, int((~group).sum())), (len(rows) - first, int(group.sum()))):
        assert size % ROWS_STEP == 0 or size == most


def test_padding_comes_from_the_given_rows() -> None:
    visible = torch.arange(4000) < 10
    among = torch.arange(4000) % 2 == 0
    rows = rows_to_shade(visible & among, among)
    assert len(rows) == ROWS_STEP
    assert bool(among[rows].all())
