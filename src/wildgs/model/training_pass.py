"""Data exchanged between the trainer and a method."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Bool, Float
from torch import Tensor, nn

from wildgs.geometry.camera import Camera
from wildgs.model.config import LearningRate
from wildgs.rasterize import Projection, Rendering


@dataclass(frozen=True)
class Stage:
    """State of the training schedule for a method's forward pass.

    Attributes:
        explicit: Whether local appearance (the triplane) is on; off in the first stage.
        learn_mask: Whether the visibility mask gets gradients.
        sh_degree: Active degree of the spherical harmonics.
        learn_encoder: Whether the image encoder gets gradients.
        learn_planes: Whether the triplane's UNet gets gradients.
        dropout: Dropout rates of the Gaussians (see `wildgs.model.dropout`); None if none is dropped.
        neighbours: Number of neighbouring Gaussians that are dropped together.
        absgrad: Whether absolute view-space gradients are collected.
    """

    explicit: bool = True
    learn_mask: bool = True
    sh_degree: int = 3
    learn_encoder: bool = True
    learn_planes: bool = True
    dropout: Float[Tensor, "N"] | None = None
    neighbours: int = 8
    absgrad: bool = False


@dataclass(frozen=True)
class TrainingOutput:
    """Result of a method's forward pass for one training photo.

    Attributes:
        rendering: Colours, expected depth and alpha.
        projection: Projection of the Gaussians, whose statistics densification uses.
        visibility: M; None for a method without a mask.
        painted: Colours of the Gaussians that were blended.
        developed: The render with the response of the photo's camera, which the loss compares; None without one.
    """

    rendering: Rendering
    projection: Projection
    visibility: Float[Tensor, "H W"] | None
    painted: Float[Tensor, "N 3"]
    developed: Float[Tensor, "H W 3"] | None = None

    @property
    def picture(self) -> Float[Tensor, "H W 3"]:
        """The render that is compared with the photo."""
        return self.rendering.colors if self.developed is None else self.developed


@dataclass(frozen=True)
class ParameterGroup:
    """Network parameters that share a learning rate.

    Attributes:
        name: Name, unique among the groups of a method.
        parameters: The parameters; no per-Gaussian ones, which have `Method.row_rates`.
        rate: Their learning rate.
    """

    name: str
    parameters: list[nn.Parameter]
    rate: LearningRate


@dataclass(frozen=True)
class SeenPhoto:
    """A photo with its camera.

    Attributes:
        photo: RGB in [0, 1].
        camera: Its camera, of the photo's size.
        keep: The user's mask: False = ignore the pixel.
        name: Name of the photo.
    """

    photo: Float[Tensor, "H W 3"]
    camera: Camera
    keep: Bool[Tensor, "H W"] | None
    name: str
