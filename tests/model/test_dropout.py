"""Dropout of Gaussians."""

from __future__ import annotations

import pytest
import torch

from wildgs.model.config import DropoutConfig
from wildgs.model.dropout import opacity_factors


def test_it_grows_with_training_and_is_off_where_photos_are_many() -> None:
    config = DropoutConfig(rate=0.2, photos=50)
    assert config.rate_at(0.0, 10) == 0.0
    assert config.rate_at(1.0, 10) == pytest.approx(0.16)
    assert config.rate_at(0.5, 10) == pytest.approx(0.08)
    assert config.rate_at(1.0, 50) == config.rate_at(1.0, 500) == 0.0


def test_runs_of_neighbours_are_left_out_and_opacity_stays_in_the_mean() -> None:
    torch.manual_seed(0)
    factors = opacity_factors(10_000, 0.2, 8, torch.device("cpu"))
    assert len(factors) == 10_000
    assert set(factors.unique().tolist()) == {0.0, 1.25}
    assert float(factors.mean()) == pytest.approx(1.0, abs=0.05)
    changes = int((factors[1:] != factors[:-1]).sum())
    assert changes < 2 * 0.2 * 10_000 / 8
    assert len(opacity_factors(5, 0.5, 8, torch.device("cpu"))) == 5
