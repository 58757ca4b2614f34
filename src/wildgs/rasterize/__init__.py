"""Differentiable Gaussian rasteriser: one interface for CPU (Numba), CUDA (gsplat) and a dense torch reference."""

from wildgs.rasterize.dispatch import (
    blend,
    blend_sample,
    pick_backend,
    project,
    rasterize,
    sh_to_colors,
)
from wildgs.rasterize.interface import EPS2D, BackendName, Projection, Rendering

__all__ = [
    "EPS2D",
    "BackendName",
    "Projection",
    "Rendering",
    "blend",
    "blend_sample",
    "pick_backend",
    "project",
    "rasterize",
    "sh_to_colors",
]
