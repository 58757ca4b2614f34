"""Presets: named changes of the default configuration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, get_args

from wildgs.config import RunConfig, with_entries
from wildgs.model.config import RESNET18
from wildgs.plain_values import to_plain

PresetName = Literal["default", "paper", "paper-mended", "fast"]
PRESET_NAMES: tuple[PresetName, ...] = get_args(PresetName)


@dataclass(frozen=True)
class Preset:
    """Changes of the default configuration.

    Attributes:
        entries: Paths of entries in `config.yaml` and their plain values.
        steps: Factor on the number of training steps.
    """

    entries: Mapping[str, Any] = field(default_factory=dict)
    steps: float = 1.0


_PAPER: dict[str, Any] = {
    "model.parsing.encoder": RESNET18,
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
    "model.sky.densify": True,
    "model.sky.complete": False,
    "model.color_match": False,
    "model.camera_response.vignetting": False,
    "model.camera_response.curve": False,
    "model.light_codes": 0,
    "model.light_components": 0,
    "model.matched_loss": 0.0,
    "model.embedding_scale": 1.0,
    "model.eps2d": 0.3,
    "model.antialiased": False,
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
    "train.dropout.rate": 0.0,
    "train.flat_ground.rate": 0.0,
    "train.warp.residuals": False,
    "train.warp.rate": 0.0,
    "train.density.strategy": "classic",
    "train.density.prune_by_distance": False,
    "train.density.prune_reach": 0.0,
    "train.density.reset_unseen": True,
}
"""Switches off the additions of the default configuration and sets the paper's values."""
_PRINTED: dict[str, Any] = {
    "model.parsing.bounded_logits": False,
    "model.fusion.direct_path": False,
    "train.objective.mask_gradient": "loss",
    "train.schedule.mask_pause": 0,
}
"""Additions of the default that stabilise training of mask and fusion; the preset `paper-mended` keeps them."""

PRESETS: dict[PresetName, Preset] = {
    "default": Preset(),
    "paper": Preset(_PAPER | _PRINTED),
    "paper-mended": Preset(_PAPER),
    "fast": Preset(steps=0.5),
}
"""Measurements: docs/study.md. Values that the paper leaves open: docs/decisions.md."""


def with_preset(config: RunConfig, name: PresetName) -> RunConfig:
    """Applies a preset to a configuration; entries that its method does not have are skipped."""
    preset = PRESETS[name]
    entries = {path: value for path, value in preset.entries.items() if _has(config, path)}
    changed = with_entries(config, entries, f"preset {name}")
    return replace(
        changed, train=replace(changed.train, steps=max(1, round(preset.steps * config.train.steps)))
    )


def _has(config: RunConfig, path: str) -> bool:
    """Whether a configuration has an entry."""
    plain: Any = to_plain(config)
    for name in path.split("."):
        if not isinstance(plain, dict) or name not in plain:
            return False
        plain = plain[name]
    return True
