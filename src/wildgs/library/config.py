"""Options of the library's functions: plain dataclasses, importable without torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal, get_args

import tyro

from wildgs.model.config import WRAPPING_PARTS, Ablation
from wildgs.model.registry import DEFAULT_METHOD, METHODS
from wildgs.presets import PRESET_NAMES, PresetName

ExportFormat = Literal["html", "glb", "usd", "ply", "compressed.ply", "splat", "spz", "sog"]
"""Files with several lights (the page, glTF, OpenUSD), and files with one."""

Suite = Literal["phototourism"]
HALF = "-half-steps"
WITHOUT = "without-"
BENCH_METHODS: tuple[str, ...] = (
    *(name for name in METHODS if name != DEFAULT_METHOD),
    DEFAULT_METHOD + HALF,
    DEFAULT_METHOD,
    *PRESET_NAMES,
    *(WITHOUT + part for part in get_args(Ablation)),
)
"""Lines that a benchmark can have: methods, half of the steps, presets, and the ablations of Wild-GS."""


def reference_preset(suite: Suite | None) -> PresetName:
    """The preset that `wildgs`, its half-length run and its ablations stand for in a benchmark's table.

    The figures of the paper are those of the paper's own method, hence the preset `paper` for its suite.
    """
    return "default" if suite is None else "paper"


def default_bench_methods(suite: Suite | None) -> tuple[str, ...]:
    """All of `BENCH_METHODS` but the preset that `wildgs` stands for already, and what it has nothing of.

    The default has no 3D Wrapping, of which parts could be left out.
    """
    absent = [WITHOUT + part for part in WRAPPING_PARTS] if suite is None else []
    return tuple(name for name in BENCH_METHODS if name not in (reference_preset(suite), *absent))


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
    sky: str | None = None
    """Take the sky from this appearance instead."""


@dataclass(frozen=True)
class TrajectoryOptions:
    """A camera path and its frames."""

    path: str | None = None
    """orbit, training, spiral, views (through --view), still (at --view), or a camera file (docs/cameras.md)."""
    seconds: float | None = None
    """Length of the video in seconds; by default 5, and 10 for --over day."""
    fps: float | None = None
    """Frames per second; by default 30, or the camera file's own."""
    size: tuple[int, int] | None = None
    """Width and height in pixels; by default those of the photos."""
