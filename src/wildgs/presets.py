"""Named configurations: the paper to the letter, the best that we measured, and the quick one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, get_args

from wildgs.config import RunConfig, with_entries
from wildgs.model.config import RESNET18

PresetName = Literal["default", "paper", "fast"]
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


PRESETS: dict[PresetName, Preset] = {
    "default": Preset(),
    "paper": Preset(
        {
            "model.parsing.encoder": RESNET18,
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
    ),
    "fast": Preset({"model.parsing.max_side": 192}, steps=0.5),
}
"""docs/study.md has the measurements; docs/decisions.md says where the paper leaves the value open."""


def with_preset(config: RunConfig, name: PresetName) -> RunConfig:
    """A configuration with a preset's entries and share of the steps."""
    preset = PRESETS[name]
    changed = with_entries(config, preset.entries, f"preset {name}")
    return replace(
        changed, train=replace(changed.train, steps=max(1, round(preset.steps * config.train.steps)))
    )
