"""Entries of a run's configuration changed by path."""

from __future__ import annotations

from pathlib import Path

import pytest

from wildgs.config import RunConfig, differing_entries, with_entries
from wildgs.errors import UserError
from wildgs.model.config import WrappingConfig

BASE = RunConfig(Path("scene"))


def test_changes_what_it_names_and_nothing_else():
    changed = with_entries(BASE, {"train.optimizer.networks": 2, "model.wrapping.widths": [8, 16]})
    assert changed.train.optimizer.networks == 2.0
    assert changed.model.wrapping.widths == (8, 16)
    assert differing_entries(BASE, changed) == {
        "train.optimizer.networks": (BASE.train.optimizer.networks, 2.0),
        "model.wrapping.widths": (list(BASE.model.wrapping.widths), [8, 16]),
    }
    assert BASE.train.optimizer.networks != 2


@pytest.mark.parametrize(
    ("entries", "said"),
    [
        ({"train.optimiser.networks": 1.0}, "unknown entry 'optimiser'"),
        ({"train.optimizer.network": 1.0}, "known are"),
        ({"train.steps": "many"}, "config.train.steps: 'many' is not a int"),
        ({"train.steps.more": 1}, "steps is a value"),
        ({"method": "nerf"}, "config.method"),
        ({"data.downscale": 0}, "downscale"),
    ],
)
def test_what_does_not_exist_or_fit_is_named(entries, said):
    with pytest.raises(UserError, match=said):
        with_entries(BASE, entries)


@pytest.mark.parametrize(
    "wrong",
    [{"resolution": 200_000}, {"resolution": 0}, {"features": 10**6}, {"widths": ()}, {"widths": (8, 10**6)},
     {"crop_ratio": 0.0}, {"crop_ratio": float("nan")}, {"box_quantile": 0.5}, {"partial_lifts": 2.0}],
)  # fmt: skip
def test_planes_that_no_memory_holds_are_refused(wrong: dict) -> None:
    """A configuration file may say 200,000 cells a side, which are 1.9 TB."""
    (name,) = wrong
    with pytest.raises(UserError, match=f"wrapping.{name} "):
        WrappingConfig(**wrong)
