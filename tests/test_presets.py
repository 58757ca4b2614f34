"""Presets: what they set."""

from __future__ import annotations

from pathlib import Path

import pytest

from wildgs.config import RunConfig, differing_entries
from wildgs.presets import PresetName, with_preset

BASE = RunConfig(Path("scene"))


def test_default_changes_nothing() -> None:
    assert with_preset(BASE, "default") == BASE


MENDED = {
    "model.parsing.encoder": "microsoft/resnet-18",
    "model.parsing.max_side": 256,
    "model.local_embeddings": True,
    "model.wrapping.resolution": 128,
    "model.parsing.decoder_widths": [128, 64, 32],
    "model.parsing.color_statistics": False,
    "model.fusion.color_transform": False,
    "model.fusion.sh_degree": 3,
    "model.fusion.hidden": 64,
    "model.depth_points.points": 0,
    "model.wrapping.partial_lifts": 0.0,
    "model.ground.points": 0,
    "model.sky.points": 0,
    "train.dropout.rate": 0.0,
    "train.flat_ground.rate": 0.0,
    "train.warp.residuals": False,
    "train.warp.rate": 0.0,
    "model.sky.densify": True,
    "model.sky.complete": False,
    "model.color_match": False,
    "model.light_codes": 0,
    "model.eps2d": 0.3,
    "model.antialiased": False,
    "model.light_components": 0,
    "model.matched_loss": 0.0,
    "model.embedding_scale": 1.0,
    "train.objective.depth_weight": 0.05,
    "train.objective.metric_weight": 0.0,
    "train.objective.sky_weight": 0.0,
    "train.objective.opaque_weight": 0.0,
    "train.objective.mask_weight_photos": 0,
    "train.objective.mask_power": 1.0,
    "train.objective.consensus": False,
    "train.objective.free_space": False,
    "train.schedule.encoder_every": 1,
    "train.schedule.reset_every": 3000,
    "train.schedule.mask_every": 1,
    "train.schedule.mask_visits": 0,
    "train.schedule.planes_every": 1,
    "train.optimizer.short_runs": 0.0,
    "train.density.strategy": "classic",
    "train.density.prune_by_distance": False,
    "train.density.prune_reach": 0.0,
    "train.density.reset_unseen": True,
}
PRINTED = MENDED | {
    "model.parsing.bounded_logits": False,
    "model.fusion.direct_path": False,
    "train.objective.mask_gradient": "loss",
    "train.schedule.mask_pause": 0,
}


@pytest.mark.parametrize(("name", "expected"), [("paper", PRINTED), ("paper-mended", MENDED)])
def test_paper_leaves_out_all_that_is_ours(name: PresetName, expected: dict[str, object]) -> None:
    changed = differing_entries(BASE, with_preset(BASE, name))
    assert {path: new for path, (_, new) in changed.items()} == expected


def test_entries_of_another_method_are_left_out() -> None:
    vanilla = with_preset(BASE.with_method("3dgs"), "paper")
    assert vanilla.model == BASE.with_method("3dgs").model
    assert vanilla.train.density.prune_reach == 0


def test_fast_takes_half_the_steps_asked_for() -> None:
    assert with_preset(BASE, "fast").train.steps == BASE.train.steps // 2
