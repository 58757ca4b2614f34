"""Plain 3D Gaussian Splatting (Kerbl et al. 2023) on the same engine: the paper's baseline `3dgs`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from wildgs.geometry.camera import Camera
from wildgs.geometry.spherical_harmonics import rgb_to_sh0
from wildgs.model.appearance import Appearance, Embeddings
from wildgs.model.config import LearningRate, VanillaConfig
from wildgs.model.gaussians import Gaussians
from wildgs.model.initial import InitialGaussians
from wildgs.model.method import (
    GEOMETRY_ROWS,
    MemoryUse,
    Method,
    Stage,
    TrainingOutput,
    paint_visible,
)
from wildgs.model.rows import take_rows
from wildgs.rasterize import blend

SH_DEGREE = 3


class VanillaGS(Method):
    """Every Gaussian owns its spherical harmonics; photos have no say in the colours."""

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
        """Starts from the points' colours."""
        harmonics = {
            "sh0": rgb_to_sh0(initial.colors)[:, None],
            "shN": torch.zeros(len(initial.colors), *cls.rows(config)["shN"]),
        }
        return cls(config, Gaussians(initial.rows | harmonics))

    @classmethod
    def blank(cls, config: VanillaConfig, gaussians: Gaussians, state: Mapping[str, Tensor]) -> VanillaGS:
        """The Gaussians are all there is."""
        return cls(config, gaussians)

    def row_rates(self) -> dict[str, LearningRate]:
        """Those of the harmonics."""
        rates = self.config.learning_rates
        return {"sh0": LearningRate(rates.sh0), "shN": LearningRate(rates.shN)}

    def encode(
        self,
        photo: Float[Tensor, "H W 3"],
        camera: Camera,
        keep: Bool[Tensor, "H W"] | None = None,
        *,
        name: str | None = None,
        trust_mask: bool = True,
        explicit: bool = True,
    ) -> Appearance:
        """Nothing: this method knows one light only."""
        return Appearance()

    def embed(self, appearance: Appearance, rows: Int[Tensor, " V"] | None = None) -> Embeddings:
        """An empty embedding."""
        return Embeddings(self.gaussians.means.new_zeros(0))

    def fuse(self, embeddings: Embeddings, rows: Int[Tensor, " V"] | None = None) -> Float[Tensor, "N K 3"]:
        """The stored harmonics."""
        stored = self.gaussians.rows
        parts = [stored["sh0"], stored["shN"]]
        return torch.cat(parts if rows is None else [take_rows(part, rows) for part in parts], dim=1)

    def training_pass(
        self,
        photo: Float[Tensor, "H W 3"],
        camera: Camera,
        stage: Stage,
        keep: Bool[Tensor, "H W"] | None = None,
        *,
        name: str | None = None,
    ) -> TrainingOutput:
        """Renders the camera's view; the photo plays no part."""
        projection = self.gaussians.project(camera)
        projection.means2d.retain_grad()
        colors = paint_visible(self, projection, Appearance(), stage.sh_degree)
        return TrainingOutput(blend(projection, colors), projection, None)
