"""Options of the library's functions: plain dataclasses, importable without torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal, get_args

import tyro

from wildgs.model.config import Ablation
from wildgs.model.registry import DEFAULT_METHOD, METHODS
from wildgs.presets import PRESET_NAMES

ExportFormat = Literal["html", "ply", "compressed.ply", "splat", "spz", "sog"]
"""The page, and files for other programs."""

Suite = Literal["phototourism"]
HALF = "-half-steps"
WITHOUT = "without-"
BENCH_METHODS: tuple[str, ...] = (
    *(name for name in METHODS if name != DEFAULT_METHOD),
    DEFAULT_METHOD + HALF,
    DEFAULT_METHOD,
    *(name for name in PRESET_NAMES if name != "default"),
    *(WITHOUT + part for part in get_args(Ablation)),
)
"""Lines of the bench's table: methods, half of the steps, presets, and the ablations of Wild-GS."""


@dataclass(frozen=True)
class MixOptions:
    """How appearances are found and mixed."""

    weights: tuple[float, ...] = ()
    """Mix the appearances into one with these weights, which add up to 1."""
    global_: Annotated[str | None, tyro.conf.arg(name="global")] = None
    """Take the global colour and brightness from this appearance instead."""
    local: str | None = None
    """Take local effects (shadows, lamps) from this appearance instead."""
    like: str | None = None
    """Photo of the scene whose camera and depth a picture borrows instead of being localised, or auto."""


@dataclass(frozen=True)
class TrajectoryOptions:
    """A camera path and its frames."""

    path: str | None = None
    """orbit, training, spiral, views (through --view), still (at --view), or a camera file (docs/cameras.md)."""
    seconds: float = 5.0
    """Length of the video in seconds."""
    fps: float | None = None
    """Frames per second; by default 30, or the camera file's own."""
    size: tuple[int, int] | None = None
    """Width and height in pixels; by default those of the photos."""
