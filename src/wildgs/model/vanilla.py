"""Plain 3D Gaussian Splatting (Kerbl et al. 2023) on the same engine: the paper's baseline `3dgs`."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from wildgs.geometry.camera import Camera
from wildgs.geometry.spherical_harmonics import rgb_to_sh0
from wildgs.model.appearance import Appearance
from wildgs.model.gaussians import Gaussians, colors_to_unit, geometry_from_points
from wildgs.model.method import Method, Stage, TrainingOutput, paint_visible
from wildgs.model.rows import take_rows
from wildgs.rasterize import blend


class VanillaGS(Method):
    """Every Gaussian owns its spherical harmonics; photos have no say in the colours."""

    def __init__(self, gaussians: Gaussians) -> None:
        super().__init__()
        self.gaussians = gaussians

    @classmethod
    def from_points(cls, points: Float[Tensor, "P 3"], colors: UInt8[Tensor, "P 3"]) -> VanillaGS:
        """Starts from SfM points and their colours."""
        rows = geometry_from_points(points)
        rows["sh0"] = rgb_to_sh0(colors_to_unit(colors))[:, None]
        rows["shN"] = torch.zeros(len(points), (cls.sh_degree + 1) ** 2 - 1, 3)
        return cls(Gaussians(rows))

    def encode(
        self,
        photo: Float[Tensor, "H W 3"],
        camera: Camera,
        keep: Bool[Tensor, "H W"] | None = None,
        *,
        trust_mask: bool = True,
    ) -> Appearance:
        """Nothing: this method knows one light only."""
        return Appearance()

    def shade(self, appearance: Appearance, rows: Int[Tensor, " V"] | None = None) -> Float[Tensor, "N K 3"]:
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
