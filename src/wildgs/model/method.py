"""What a method is to the trainer, the evaluation and every tool: encode, shade, render."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from wildgs.geometry.camera import Camera
from wildgs.model.appearance import Appearance
from wildgs.model.gaussians import Gaussians
from wildgs.model.rows import rows_to_shade, take_rows
from wildgs.rasterize import Projection, Rendering, blend, sh_to_colors


@dataclass(frozen=True)
class Stage:
    """Where training stands, as far as a method's forward pass cares.

    Attributes:
        explicit: Whether local appearance (the triplane) is on: off in the paper's first stage.
        learn_mask: Whether the visibility mask takes gradients now.
        sh_degree: Active degree of the spherical harmonics.
        learn_encoder: Whether the photo's encoder takes gradients now.
    """

    explicit: bool = True
    learn_mask: bool = True
    sh_degree: int = 3
    learn_encoder: bool = True


@dataclass(frozen=True)
class TrainingOutput:
    """One training view's forward pass.

    Attributes:
        rendering: Colours, expected depth and alpha.
        projection: Its screen statistics feed densification.
        visibility: M, or None for a method without a mask.
    """

    rendering: Rendering
    projection: Projection
    visibility: Float[Tensor, "H W"] | None


class Method(nn.Module, ABC):
    """A set of Gaussians and a way to colour them.

    Attributes:
        gaussians: The Gaussians.
        sh_degree: Degree of the spherical harmonics that `shade` gives.
        mask_threshold: Th: pixels with a visibility above it count as static.
        depth_supervised: Whether the depth loss applies to this method.
    """

    gaussians: Gaussians
    sh_degree: int = 3
    mask_threshold: float = 0.5
    depth_supervised: bool = False

    def prepare(self, photos: Sequence[Float[Tensor, "_ _ 3"]]) -> None:
        """Looks at some training photos (RGB in [0, 1]) once, before the first step."""

    @property
    def num_gaussians(self) -> int:
        """N."""
        return len(self.gaussians)

    @abstractmethod
    def encode(
        self,
        photo: Float[Tensor, "H W 3"],
        camera: Camera,
        keep: Bool[Tensor, "H W"] | None = None,
        *,
        trust_mask: bool = True,
    ) -> Appearance:
        """Reads the appearance of a photo.

        Args:
            photo: RGB in [0, 1].
            camera: Its camera, of the photo's size.
            keep: The user's own mask: pixels that are False are not lifted.
            trust_mask: Whether pixels that the method takes for transient are left out too. Not for pictures that
                are no photo of the place: there is nobody in the way, and everything is unusual.
        """

    def visibility(self, photo: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W"] | None:
        """M of a photo (RGB in [0, 1]) and nothing else of `encode`; None for a method without a mask."""
        return None

    @abstractmethod
    def shade(self, appearance: Appearance, rows: Int[Tensor, " V"] | None = None) -> Float[Tensor, "N K 3"]:
        """Spherical harmonics of the Gaussians under an appearance.

        Args:
            appearance: From `encode`.
            rows: Indices of the Gaussians to shade; None for all.
        """

    @abstractmethod
    def training_pass(
        self,
        photo: Float[Tensor, "H W 3"],
        camera: Camera,
        stage: Stage,
        keep: Bool[Tensor, "H W"] | None = None,
        *,
        name: str | None = None,
    ) -> TrainingOutput:
        """Renders a training photo under its own appearance, with gradients.

        Args:
            photo: RGB in [0, 1].
            camera: Its camera, of the photo's size.
            stage: Where training stands.
            keep: The user's own mask: pixels that are False are not lifted.
            name: The photo's, by which what never changes of it may be kept.
        """

    def render(
        self,
        camera: Camera,
        sh: Float[Tensor, "N K 3"],
        *,
        background: Float[Tensor, " 3"] | None = None,
    ) -> Rendering:
        """Rasterises the Gaussians under shaded harmonics: plain 3D Gaussian Splatting."""
        projection = self.gaussians.project(camera)
        colors = sh_to_colors(
            self.gaussians.means, sh, camera, degree=self.sh_degree, visible=projection.visible
        )
        return blend(projection, colors, background=background)


def paint_visible(
    method: Method, projection: Projection, appearance: Appearance, sh_degree: int
) -> Float[Tensor, "N 3"]:
    """Colours of the Gaussians that a camera sees; zero for all others, which are not even shaded."""
    means = method.gaussians.means
    rows = rows_to_shade(projection.visible)
    sh = method.shade(appearance, rows)
    seen = sh_to_colors(take_rows(means, rows), sh, projection.camera, degree=sh_degree)
    return torch.zeros_like(means).index_copy(0, rows, seen)
