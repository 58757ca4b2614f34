"""Adaptive density control: strategies to add and remove Gaussians during training, one module each."""

from wildgs.engine.density.classic import AbsGradDensity, ClassicDensity
from wildgs.engine.density.control import DensityControl, DensityReport, SeenView, ViewStatistics
from wildgs.engine.density.mcmc import McmcDensity
from wildgs.engine.density.relocation import RelocationDensity

STRATEGIES: dict[str, type[DensityControl]] = {
    "classic": ClassicDensity,
    "absgrad": AbsGradDensity,
    "relocation": RelocationDensity,
    "mcmc": McmcDensity,
}
"""Strategies by the names of `DensityConfig.strategy`."""

__all__ = [
    "STRATEGIES",
    "AbsGradDensity",
    "ClassicDensity",
    "DensityControl",
    "DensityReport",
    "McmcDensity",
    "RelocationDensity",
    "SeenView",
    "ViewStatistics",
]
