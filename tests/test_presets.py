"""Presets: what they set."""

from __future__ import annotations

from pathlib import Path

from wildgs.config import RunConfig, differing_entries
from wildgs.presets import with_preset

BASE = RunConfig(Path("scene"))


def test_default_changes_nothing() -> None:
    assert with_preset(BASE, "default") == BASE


def test_paper_leaves_out_all_that_is_ours() -> None:
    changed = differing_entries(BASE, with_preset(BASE, "paper"))
    assert {path: new for path, (_, new) in changed.items()} == {
        "model.parsing.encoder": "microsoft/resnet-18",
        "model.parsing.color_statistics": False,
        "model.wrapping.resolution": 128,
        "model.fusion.color_transform": False,
        "model.fusion.sh_degree": 3,
        "model.depth_points.points": 0,
        "model.wrapping.partial_lifts": 0.0,
        "model.ground.points": 0,
        "model.sky.points": 0,
        "model.color_match": False,
        "train.objective.depth_weight": 0.05,
        "train.schedule.encoder_every": 1,
    }


def test_fast_takes_half_the_steps_asked_for() -> None:
    assert with_preset(BASE, "fast").train.steps == BASE.train.steps // 2
