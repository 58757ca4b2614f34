"""What training and a method hand each other."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Bool, Float
from torch import Tensor, nn

from wildgs.geometry.camera import Camera
from wildgs.model.config import LearningRate
from wildgs.rasterize import Projection, Rendering


@dataclass(frozen=True)
class Stage:
    """The state of the training schedule that a method's forward pass depends on.

    Attributes:
        explicit: Whether local appearance (the triplane) is on: off in the paper's first stage.
        learn_mask: Whether the visibility mask takes gradients now.
        sh_degree: Active degree of the spherical harmonics.
        learn_encoder: Whether the photo's encoder takes gradients now.
        learn_planes: Whether the triplane's UNet takes gradients now.
        dropout: Share of the Gaussians that is left out now (see `wildgs.model.dropout`).
        neighbours: Gaussians that are left out together.
        absgrad: Whether absolute screen gradients are collected.
    """

    explicit: bool = True
    learn_mask: bool = True
    sh_degree: int = 3
    learn_encoder: bool = True
    learn_planes: bool = True
    dropout: float = 0.0
    neighbours: int = 8
    absgrad: bool = False


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


@dataclass(frozen=True)
class ParameterGroup:
    """Network parameters that share a learning rate.

    Attributes:
        name: Unique among the groups of a method.
        parameters: Not rows of the Gaussians: those have `Method.row_rates`.
        rate: Their learning rate.
    """

    name: str
    parameters: list[nn.Parameter]
    rate: LearningRate


@dataclass(frozen=True)
class SeenPhoto:
    """A training photo, as `Method.finish` gets it.

    Attributes:
        photo: RGB in [0, 1].
        camera: Its camera, of the photo's size.
        keep: The user's own mask: pixels that are False are not read.
        name: The photo's.
    """

    photo: Float[Tensor, "H W 3"]
    camera: Camera
    keep: Bool[Tensor, "H W"] | None
    name: str
