"""Named configurations: the default, the paper as printed, the paper with training as by default, the quick one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, get_args

from wildgs.config import RunConfig, to_plain, with_entries
from wildgs.model.config import RESNET18

PresetName = Literal["default", "paper", "paper-mended", "fast"]
PRESET_NAMES: tuple[PresetName, ...] = get_args(PresetName)


@dataclass(frozen=True)
class Preset:
    """What a named configuration changes.

    Attributes:
        entries: From an entry's path in `config.yaml` to its plain value.
        steps: Share of the steps asked for that are taken.
    """

    entries: Mapping[str, Any] = field(default_factory=dict)
    steps: float = 1.0


_PAPER: dict[str, Any] = {
    "model.parsing.encoder": RESNET18,
    "model.local_embeddings": True,
    "model.wrapping.resolution": 128,
    "model.parsing.decoder_widths": [128, 64, 32],
    "model.parsing.color_statistics": False,
    "model.fusion.color_transform": False,
    "model.fusion.sh_degree": 3,
    "model.depth_points.points": 0,
    "model.wrapping.partial_lifts": 0.0,
    "model.ground.points": 0,
    "model.sky.points": 0,
    "model.sky.densify": True,
    "model.color_match": False,
    "model.light_codes": 0,
    "model.light_components": 0,
    "model.matched_loss": 0.0,
    "model.eps2d": 0.3,
    "train.objective.depth_weight": 0.05,
    "train.objective.metric_weight": 0.0,
    "train.schedule.encoder_every": 1,
    "train.schedule.reset_every": 3000,
    "train.schedule.mask_every": 1,
    "train.schedule.planes_every": 1,
    "train.optimizer.short_runs": 0.0,
    "train.density.strategy": "classic",
    "train.density.prune_by_distance": False,
    "train.density.prune_reach": 0.0,
    "train.density.reset_unseen": True,
}
"""What the default has and the paper does not have, switched off or set to the paper's value."""
_PRINTED: dict[str, Any] = {
    "model.parsing.bounded_logits": False,
    "model.fusion.direct_path": False,
    "train.objective.mask_gradient": "loss",
    "train.schedule.mask_pause": 0,
}
"""Further options of the default that the paper does not have; the preset `paper-mended` keeps them on.

They concern how the mask and the fusion train, not what the model can represent.
"""

PRESETS: dict[PresetName, Preset] = {
    "default": Preset(),
    "paper": Preset(_PAPER | _PRINTED),
    "paper-mended": Preset(_PAPER),
    "fast": Preset({"model.parsing.max_side": 192}, steps=0.5),
}
"""docs/study.md has the measurements; docs/decisions.md says where the paper leaves the value open."""


def with_preset(config: RunConfig, name: PresetName) -> RunConfig:
    """A configuration with a preset's entries and share of the steps.

    Entries that the configuration's method does not have are left out.
    """
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
