"""Options of the library's functions: plain dataclasses, importable without torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal, get_args

import tyro

ExportFormat = Literal["html", "ply", "compressed.ply", "splat", "spz", "sog"]
"""The page, and files for other programs."""

Suite = Literal["phototourism"]
BenchMethod = Literal[
    "3dgs",
    "wildgs-half-steps",
    "wildgs",
    "paper",
    "fast",
    "without-crop",
    "without-reverse",
    "without-global",
    "without-mask",
    "without-depth",
    "without-intrinsic",
    "without-local",
]
METHODS: tuple[BenchMethod, ...] = get_args(BenchMethod)
"""Lines of the bench's table."""


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
