"""Dropout of Gaussians that few photos show."""

from __future__ import annotations

import pytest
import torch

from wildgs.model.config import DropoutConfig
from wildgs.model.dropout import dropout_rates, opacity_factors


def test_the_rate_falls_with_the_number_of_photos() -> None:
    photos = torch.tensor([0.0, 1.0, 3.0, 7.5, 12.0, 500.0])
    rates = dropout_rates(DropoutConfig(rate=0.2, photos=12), photos)
    assert rates.tolist() == pytest.approx([0.2, 0.2, 0.2, 0.1, 0.0, 0.0])
    assert not dropout_rates(DropoutConfig(rate=0.2, photos=0), photos).any()


def test_runs_of_neighbours_are_left_out_and_opacity_stays_in_the_mean() -> None:
    torch.manual_seed(0)
    factors = opacity_factors(torch.full((10_000,), 0.2), 8)
    assert len(factors) == 10_000
    assert set(factors.unique().tolist()) == {0.0, 1.25}
    assert float(factors.mean()) == pytest.approx(1.0, abs=0.05)
    changes = int((factors[1:] != factors[:-1]).sum())
    assert changes < 2 * 0.2 * 10_000 / 8
    assert len(opacity_factors(torch.full((5,), 0.5), 8)) == 5


def test_gaussians_that_many_photos_show_are_never_dropped() -> None:
    rates = torch.tensor([0.0, 0.9]).repeat(500)
    for _ in range(5):
        factors = opacity_factors(rates, 8)
        assert factors[::2].eq(1).all()
        assert factors[1::2].eq(0).any()
