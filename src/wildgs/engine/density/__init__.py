"""Density control: which Gaussians are added and taken away in training; a file for each strategy."""

from wildgs.engine.density.classic import AbsGradDensity, ClassicDensity
from wildgs.engine.density.control import DensityControl, DensityReport, SeenView, ViewStatistics
from wildgs.engine.density.relocation import RelocationDensity

STRATEGIES: dict[str, type[DensityControl]] = {
    "classic": ClassicDensity,
    "absgrad": AbsGradDensity,
    "relocation": RelocationDensity,
}
"""By the names of `DensityConfig.strategy`."""

__all__ = [
    "STRATEGIES",
    "AbsGradDensity",
    "ClassicDensity",
    "DensityControl",
    "DensityReport",
    "RelocationDensity",
    "SeenView",
    "ViewStatistics",
]
