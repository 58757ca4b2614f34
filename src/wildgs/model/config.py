"""Configuration of Wild-GS and plain 3DGS: plain dataclasses, importable without torch."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from wildgs.errors import UserError
from wildgs.priors.config import DepthPointsConfig, GroundConfig

SQUEEZENET = "squeezenet"
"""The encoder that ships with the package."""
RESNET18 = "microsoft/resnet-18"

Precision = Literal["auto", "float32", "bfloat16"]
Ablation = Literal["crop", "reverse", "global", "mask", "depth", "intrinsic", "local"]
"""Parts that can be left out: the paper's five ablations, and the intrinsic and local features."""


WRAPPING_PARTS: tuple[Ablation, ...] = ("local", "reverse", "crop")
"""Ablations of 3D Wrapping."""
WRAPPING_RANGES = {
    "resolution": (4, 1024),
    "features": (1, 512),
    "local_size": (1, 512),
    "crop_ratio": (0.01, 1.0),
    "box_quantile": (0.0, 0.25),
    "partial_lifts": (0.0, 1.0),
}
"""Smallest and largest values; at 1024 cells a side the planes take some GB."""


@dataclass(frozen=True)
class ParsingConfig:
    """2D Parsing.

    Attributes:
        encoder: `squeezenet` for the frozen features that ship with the package; else a ResNet-18 that learns: its
            folder or hub name (paper: `microsoft/resnet-18`).
        max_side: Photos are shrunk to this many pixels on the long side before parsing; the mask is blurry
            anyway, and cost grows with the square.
        color_statistics: Whether M^G also reads mean and spread of the photo's own colours. Not in the paper; but
            what five stages leave of a photo says little of its colour cast.
        global_size: Length of the global embedding (paper: 16).
        decoder_widths: Channels of the mask decoder at 1/16, 1/8 and 1/4.
        bounded_logits: Whether M stays where its sigmoid passes a gradient, so that masks which closed or opened
            everywhere can come back. Not in the paper.
    """

    encoder: str = SQUEEZENET
    max_side: int = 256
    color_statistics: bool = True
    global_size: int = 16
    decoder_widths: tuple[int, int, int] = (64, 32, 16)
    bounded_logits: bool = True


@dataclass(frozen=True)
class WrappingConfig:
    """3D Wrapping.

    Attributes:
        resolution: Cells per side of a plane.
        features: Channels of a plane's feature map.
        widths: Channels of the plane UNet, from full resolution down.
        local_size: Length of the local embedding (paper: 16).
        crop_ratio: Share of the robust box's sides that the triplane covers (paper: 0.5).
        box_quantile: Share of SfM points outside the robust box on each side of each axis.
        partial_lifts: Share of the training steps in which a part of the photo is lifted only. Not in the paper,
            where every Gaussian that is seen finds its own pixels in the planes, and those that a photo does not
            show get whatever light comes out.
    """

    resolution: int = 64
    features: int = 32
    widths: tuple[int, ...] = (16, 32, 64, 64)
    local_size: int = 16
    crop_ratio: float = 0.5
    box_quantile: float = 0.005
    partial_lifts: float = 0.5

    def __post_init__(self) -> None:
        """Refuses planes that no memory holds, and shares that are none."""
        for name, (least, most) in WRAPPING_RANGES.items():
            value = getattr(self, name)
            if not least <= value <= most:
                raise UserError(f"wrapping.{name} {value}: must be from {least:g} to {most:g}")
        if not 1 <= len(self.widths) <= 8 or not all(1 <= width <= 1024 for width in self.widths):
            raise UserError(f"wrapping.widths {self.widths}: must be 1 to 8 numbers from 1 to 1024")


@dataclass(frozen=True)
class FusionConfig:
    """The fusion network.

    Attributes:
        intrinsic_size: Length of the intrinsic feature (paper: 32).
        hidden: Width of the two hidden layers.
        sh_degree: Degree of the predicted spherical harmonics (paper: 3, as 3DGS has).
        output_scale: Factor on the output layer's initial weights.
        color_transform: Whether Emb^g also gives one affine map of colours, the same for all Gaussians: a photo's
            exposure and colour cast. Not in the paper, whose hidden layers have to learn to multiply for it.
        direct_path: Whether a linear path from the intrinsic feature to the output runs beside the hidden layers:
            training then begins at the points' colours. Not in the paper.
    """

    intrinsic_size: int = 32
    hidden: int = 64
    sh_degree: int = 1
    output_scale: float = 0.1
    color_transform: bool = True
    direct_path: bool = True

    def __post_init__(self) -> None:
        """Refuses sizes that no network can have."""
        if self.intrinsic_size < 3:
            raise UserError(
                f"intrinsic_size {self.intrinsic_size}: must be 3 or more, since it holds a Gaussian's first colour"
            )
        if self.hidden < 1:
            raise UserError(f"hidden {self.hidden}: must be 1 or more")
        if not 0 <= self.sh_degree <= 3:
            raise UserError(f"sh_degree {self.sh_degree}: must be between 0 and 3")


@dataclass(frozen=True)
class SkyConfig:
    """The shell of Gaussians that stands for the sky at the start.

    Attributes:
        points: How many; 0 leaves the sky to densification, as the paper does.
        radius: Of the shell, in units of the aligned frame (photos' median depth); more where the scene's points
            reach further.
        reach: The shell lies at this multiple of the distance within which nearly all points are, at least.
        lowest: Elevation at which the shell ends, degrees. Below the horizon it closes the scene behind ground that
            too few photos show: such holes are as dark as the background otherwise.
        opacity: Of its Gaussians at the start.
        densify: Whether its Gaussians are cloned and split as others are: clouds, which no two photos share, then
            take up to half of the budget.
    """

    points: int = 5000
    radius: float = 10.0
    reach: float = 2.0
    lowest: float = -90.0
    opacity: float = 0.5
    densify: bool = False


@dataclass(frozen=True)
class InitialConfig:
    """Gaussians at the start beside those on SfM points. None of them is in the paper.

    Attributes:
        depth_points: On surfaces that depth priors show and SfM has no points of.
        ground: That continue the ground.
        sky: That stand for the sky.
    """

    depth_points: DepthPointsConfig = field(default_factory=DepthPointsConfig)
    ground: GroundConfig = field(default_factory=GroundConfig)
    sky: SkyConfig = field(default_factory=SkyConfig)

    @classmethod
    def sfm_only(cls) -> InitialConfig:
        """SfM points alone, as 3DGS starts."""
        return cls(DepthPointsConfig(points=0), GroundConfig(points=0), SkyConfig(points=0))


@dataclass(frozen=True)
class LearningRate:
    """A learning rate that decays exponentially.

    Attributes:
        start: At the first step.
        decay: Factor reached at the last step; 1 keeps the rate constant.
    """

    start: float
    decay: float = 1.0


@dataclass(frozen=True)
class MemoryUse:
    """What training a method takes beside the decoded photos, bytes; `benchmarks/memory.py` measures it.

    Attributes:
        per_gaussian: Parameters, gradients, Adam's moments, the copies of densification, and the intermediate
            values of one view.
        per_pixel: Of the largest photo, at the size at which it trains.
        fixed: Networks with their moments and activations, and compiled kernels.
    """

    per_gaussian: int
    per_pixel: int
    fixed: int


@dataclass(frozen=True)
class WildGSRates:
    """Learning rates of what plain 3DGS does not have.

    Attributes:
        intrinsic: Intrinsic features, at the start.
        networks: All networks but the encoder, at the start.
        encoder: The encoder, at the start. At the networks' rate most of its rectifiers die within a few
            thousand steps, and the embedding of every photo becomes the same.
        decay: Factor that all three reach at the end, exponentially.
    """

    intrinsic: float = 2.5e-3
    networks: float = 1e-3
    encoder: float = 1e-4
    decay: float = 0.1


@dataclass(frozen=True)
class WildGSConfig:
    """Wild-GS.

    Attributes:
        without: Parts left out, for ablations.
        mask_threshold: Th: pixels above it are static (lifting, depth loss).
        parsing: 2D Parsing.
        local_embeddings: Whether 3D Wrapping gives every Gaussian a local embedding of the photo. In the paper it
            does; by default light codes carry what of the light varies over the scene.
        wrapping: 3D Wrapping.
        fusion: The fusion network.
        depth_points: Gaussians on what depth priors see and SfM has no points of, at the start.
        ground: Gaussians that continue the ground at the start.
        sky: Gaussians that stand for the sky at the start.
        color_match: Whether a photo's light is read in two steps: from its embedding, and then from how far the
            scene's colours under that are from the photo's. Not in the paper.
        matched_loss: How much of the colour match a training render gets before it is compared with its photo, from
            0 to 1. Not in the paper.
        light_codes: Numbers per Gaussian, linear in f^in, with which a photo's change of colours may vary over the
            landmark; 0 for none. Not in the paper.
        light_components: Size of the basis of lights in which a photo's light is fitted after the colour match
            (`wildgs.model.light_basis`); 0 for none. Not in the paper.
        eps2d: Added to the diagonal of the Gaussians' 2D covariances, square pixels. 3DGS has 0.3, which
            blurs what is as small as a pixel.
        learning_rates: Of networks and intrinsic features.
    """

    without: tuple[Ablation, ...] = ()
    mask_threshold: float = 0.5
    parsing: ParsingConfig = field(default_factory=ParsingConfig)
    local_embeddings: bool = False
    wrapping: WrappingConfig = field(default_factory=WrappingConfig)
    fusion: FusionConfig = field(default_factory=FusionConfig)
    depth_points: DepthPointsConfig = field(default_factory=DepthPointsConfig)
    ground: GroundConfig = field(default_factory=GroundConfig)
    sky: SkyConfig = field(default_factory=SkyConfig)
    color_match: bool = True
    matched_loss: float = 0.8
    light_codes: int = 8
    light_components: int = 32
    eps2d: float = 0.1
    learning_rates: WildGSRates = field(default_factory=WildGSRates)

    def __post_init__(self) -> None:
        """Refuses to leave out what is not there."""
        absent = [part for part in WRAPPING_PARTS if part in self.without]
        if absent and not self.local_embeddings:
            raise UserError(
                f"without {', '.join(absent)}: that is a part of 3D Wrapping, which is off; "
                "use it with --local-embeddings or --preset paper"
            )


@dataclass(frozen=True)
class VanillaRates:
    """Learning rates of the harmonics; values are 3DGS's.

    Attributes:
        sh0: Flat colour.
        shN: Higher harmonics.
    """

    sh0: float = 2.5e-3
    shN: float = 1.25e-4  # noqa: N815 - the field's name


@dataclass(frozen=True)
class VanillaConfig:
    """Plain 3D Gaussian Splatting.

    Attributes:
        learning_rates: Of the harmonics.
    """

    learning_rates: VanillaRates = field(default_factory=VanillaRates)


@dataclass(frozen=True)
class DropoutConfig:
    """Dropout of Gaussians in training (`wildgs.model.dropout`). Not in the paper.

    Attributes:
        rate: Share of the Gaussians that is left out at the end of training, with few photos; it grows linearly.
            0 leaves none out.
        photos: From so many training photos on nothing is left out; half as many halve the rate.
        neighbours: Gaussians that are left out together.
    """

    rate: float = 0.0
    photos: int = 50
    neighbours: int = 8

    def rate_at(self, progress: float, photos: int) -> float:
        """Share of the Gaussians that is left out.

        Args:
            progress: Share of the training done, 0 to 1.
            photos: Training photos.
        """
        few = 1.0 - photos / self.photos if self.photos else 0.0
        return self.rate * min(max(progress, 0.0), 1.0) * max(0.0, few)
