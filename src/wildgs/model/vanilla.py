"""Plain 3D Gaussian Splatting (Kerbl et al. 2023), the baseline `3dgs`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from wildgs.geometry.spherical_harmonics import rgb_to_sh0
from wildgs.model.appearance import Embeddings
from wildgs.model.config import LearningRate, MemoryUse, VanillaConfig
from wildgs.model.gaussians import GEOMETRY_ROWS, Gaussians, take_rows
from wildgs.model.initial import InitialGaussians
from wildgs.model.method import Method

SH_DEGREE = 3


class VanillaGS(Method):
    """Every Gaussian has its own spherical harmonics; colours do not depend on a photo."""

    name: ClassVar[str] = "3dgs"
    label: ClassVar[str] = "3DGS"
    Config: ClassVar[type] = VanillaConfig
    memory: ClassVar[MemoryUse] = MemoryUse(per_gaussian=2500, per_pixel=300, fixed=100 * 2**20)
    relightable: ClassVar[bool] = False
    config: VanillaConfig

    def __init__(self, config: VanillaConfig, gaussians: Gaussians) -> None:
        super().__init__()
        self.config = config
        self.gaussians = gaussians
        self.sh_degree = SH_DEGREE

    @classmethod
    def rows(cls, config: VanillaConfig) -> dict[str, tuple[int, ...]]:
        """Geometry and harmonics."""
        return GEOMETRY_ROWS | {"sh0": (1, 3), "shN": ((SH_DEGREE + 1) ** 2 - 1, 3)}

    @classmethod
    def create(cls, config: VanillaConfig, initial: InitialGaussians) -> VanillaGS:
        """Initialises SH degree 0 from the points' colours."""
        harmonics = {
            "sh0": rgb_to_sh0(initial.colors)[:, None],
            "shN": torch.zeros(len(initial.colors), *cls.rows(config)["shN"]),
        }
        return cls(config, Gaussians(initial.rows | harmonics))

    @classmethod
    def blank(cls, config: VanillaConfig, gaussians: Gaussians, state: Mapping[str, Tensor]) -> VanillaGS:
        """Creates the method from the Gaussians, which hold all parameters."""
        return cls(config, gaussians)

    def row_rates(self) -> dict[str, LearningRate]:
        """Learning rates of the harmonics."""
        rates = self.config.learning_rates
        return {"sh0": LearningRate(rates.sh0), "shN": LearningRate(rates.shN)}

    def fuse(self, embeddings: Embeddings, rows: Int[Tensor, " V"] | None = None) -> Float[Tensor, "N K 3"]:
        """The stored harmonics."""
        stored = self.gaussians.rows
        parts = [stored["sh0"], stored["shN"]]
        return torch.cat(parts if rows is None else [take_rows(part, rows) for part in parts], dim=1)
