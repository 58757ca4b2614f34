"""The CPU backend: Numba kernels behind `project`, `blend` and `sh_to_colors`."""

from wildgs.rasterize.cpu.blending import blend, blend_tiles
from wildgs.rasterize.cpu.projection import project
from wildgs.rasterize.cpu.shading import sh_to_colors

__all__ = ["blend", "blend_tiles", "project", "sh_to_colors"]
