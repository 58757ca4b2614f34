"""Options of the library's functions: plain dataclasses that do not import torch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal, get_args

import tyro

from wildgs.model.config import WRAPPING_PARTS, Ablation
from wildgs.model.registry import DEFAULT_METHOD, METHODS
from wildgs.presets import PRESET_NAMES, PresetName

ExportFormat = Literal["html", "glb", "usd", "ply", "compressed.ply", "splat", "spz", "sog"]
"""Formats for several appearances per file (html, glb, usd), and formats for one."""

Suite = Literal["phototourism"]
HALF = "-half-steps"
WITHOUT = "without-"
ENTRIES_WITHOUT: Mapping[str, Mapping[str, Any]] = {
    "stereo": {"data.use_metric_depth": False},
    "dropout": {"train.dropout.rate": 0.0},
    "flat-ground": {"train.flat_ground.rate": 0.0},
    "warp": {"train.warp.rate": 0.0, "train.warp.residuals": False},
    "growth": {"train.schedule.densify_every": 0},
}
"""Ablations of what the paper does not have: the entries of `config.yaml` that switch each part off."""
BENCH_METHODS: tuple[str, ...] = (
    *(name for name in METHODS if name != DEFAULT_METHOD),
    DEFAULT_METHOD + HALF,
    DEFAULT_METHOD,
    *PRESET_NAMES,
    *(WITHOUT + part for part in get_args(Ablation)),
    *(WITHOUT + part for part in ENTRIES_WITHOUT),
)
"""Rows that a benchmark can have: methods, Wild-GS with half the steps, presets, and the ablations of Wild-GS."""


def reference_preset(suite: Suite | None) -> PresetName:
    """The preset of the rows `wildgs`, `wildgs-half-steps` and the ablations in a benchmark's table.

    It is `paper` for the paper's suite, since these rows are compared with the paper's figures.
    """
    return "default" if suite is None else "paper"


def default_bench_methods(suite: Suite | None) -> tuple[str, ...]:
    """All of `BENCH_METHODS` except the preset of the row `wildgs`, its repetition and what does not apply to it.

    The preset `fast` equals the row of half the steps, except in the paper's suite.
    The default has no 3D Wrapping, so that the ablations of its parts do not apply. Stereo is used only if depth
    maps were made, so that its row has to be asked for. The paper's suite has the paper's ablations only.
    """
    parts = ("stereo", *WRAPPING_PARTS) if suite is None else ENTRIES_WITHOUT
    absent = {reference_preset(suite), *(WITHOUT + part for part in parts)}
    if suite is None:
        absent.add("fast")
    return tuple(name for name in BENCH_METHODS if name not in absent)


@dataclass(frozen=True)
class MixOptions:
    """How appearances are obtained and mixed."""

    weights: tuple[float, ...] = ()
    """Mix the appearances into one with these weights, which must sum to 1."""
    global_: Annotated[str | None, tyro.conf.arg(name="global")] = None
    """Use the global colour and brightness of this appearance instead."""
    local: str | None = None
    """Use the local effects (shadows, lamps) of this appearance instead."""
    like: str | None = None
    """Photo of the scene whose camera and depth are used for a new image instead of localising it; auto selects
    one."""
    sky: str | None = None
    """Use the sky of this appearance instead."""


@dataclass(frozen=True)
class TrajectoryOptions:
    """A camera path and its frames."""

    path: str | None = None
    """Camera path: orbit, training, spiral, views (through --view), still (at --view), or a camera file
    (docs/cameras.md)."""
    seconds: float | None = None
    """Length of the video in seconds. Default: 5, or 10 with --over day."""
    fps: float | None = None
    """Frames per second. Default: that of the camera file, else 30."""
    size: tuple[int, int] | None = None
    """Width and height in pixels. Default: those of the photos."""
