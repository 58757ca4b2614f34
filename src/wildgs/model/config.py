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
        encoder: Image encoder: `squeezenet`, frozen and part of the package, or the folder or hub name of a
            ResNet-18, which is fine-tuned (paper: `microsoft/resnet-18`).
        max_side: Resize photos to at most this many pixels on the longer side before parsing.
        color_statistics: Also feed mean and standard deviation of the photo's colours to the global embedding's
            MLP; the encoder's deep features carry little of the colour cast. Not in the paper.
        global_size: Length of the global embedding (paper: 16).
        decoder_widths: Channels of the mask decoder at 1/16, 1/8 and 1/4 of the resolution.
        bounded_logits: Bound the mask's logits so that its sigmoid cannot saturate and a mask that is 0 or 1
            everywhere can recover. Not in the paper.
    """

    encoder: str = SQUEEZENET
    max_side: int = 192
    color_statistics: bool = True
    global_size: int = 16
    decoder_widths: tuple[int, int, int] = (64, 32, 16)
    bounded_logits: bool = True


@dataclass(frozen=True)
class WrappingConfig:
    """3D Wrapping.

    Attributes:
        resolution: Cells along each side of a plane.
        features: Channels of a plane's feature map.
        widths: Channels of the plane UNet, from full resolution down.
        local_size: Length of the local embedding (paper: 16).
        crop_ratio: Side of the triplane as a fraction of the robust bounding box's side (paper: 0.5).
        box_quantile: Fraction of SfM points outside the robust bounding box at each end of each axis.
        partial_lifts: Fraction of training steps that lift only a part of the photo, so that the planes also learn
            to light Gaussians that the photo does not show. Not in the paper.
    """

    resolution: int = 64
    features: int = 32
    widths: tuple[int, ...] = (16, 32, 64, 64)
    local_size: int = 16
    crop_ratio: float = 0.5
    box_quantile: float = 0.005
    partial_lifts: float = 0.5

    def __post_init__(self) -> None:
        """Validates the values."""
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
        color_transform: Predict an affine colour transform from the global embedding, shared by all Gaussians, for
            the photo's exposure and colour cast. Not in the paper.
        direct_path: Add a linear skip connection from the intrinsic feature to the output, so that training starts
            from the colours of the SfM points. Not in the paper.
    """

    intrinsic_size: int = 32
    hidden: int = 32
    sh_degree: int = 1
    output_scale: float = 0.1
    color_transform: bool = True
    direct_path: bool = True

    def __post_init__(self) -> None:
        """Validates the sizes."""
        if self.intrinsic_size < 3:
            raise UserError(
                f"--fusion.intrinsic-size {self.intrinsic_size}: must be 3 or more, for a Gaussian's colour"
            )
        if self.hidden < 1:
            raise UserError(f"--fusion.hidden {self.hidden}: must be 1 or more")
        if not 0 <= self.sh_degree <= 3:
            raise UserError(f"--fusion.sh-degree {self.sh_degree}: must be between 0 and 3")


@dataclass(frozen=True)
class SkyConfig:
    """Initial Gaussians of the sky, on a sphere around the scene.

    Attributes:
        points: Number of initial sky Gaussians; 0 leaves the sky to densification, as in the paper.
        radius: Smallest radius of the sphere, in units of the aligned frame (median depth of the photos = 1).
        reach: Smallest radius of the sphere as a multiple of the radius that contains nearly all SfM points.
        lowest: Lowest elevation of sky Gaussians, degrees. Those below the horizon fill holes in the ground that
            would otherwise show the dark background.
        opacity: Initial opacity of the sky Gaussians.
        densify: Densify sky Gaussians as well. Clouds differ between photos and can then take up to half of all
            Gaussians.
        own_fusion: Predict the colours of sky Gaussians by a fusion network of their own, because clouds and haze
            follow other rules than the light on surfaces.
        complete: In directions that a photo does not show, admit only colours like those of the sky that it shows
            (`wildgs.model.sky_profile`).
    """

    points: int = 5000
    radius: float = 10.0
    reach: float = 2.0
    lowest: float = -90.0
    opacity: float = 0.5
    densify: bool = False
    own_fusion: bool = True
    complete: bool = True


@dataclass(frozen=True)
class InitialConfig:
    """Initial Gaussians in addition to those on SfM points. None of them is in the paper.

    Attributes:
        depth_points: Initial Gaussians on surfaces that depth maps show but SfM has no points on.
        ground: Initial Gaussians that extend the ground plane.
        sky: Initial Gaussians of the sky.
    """

    depth_points: DepthPointsConfig = field(default_factory=DepthPointsConfig)
    ground: GroundConfig = field(default_factory=GroundConfig)
    sky: SkyConfig = field(default_factory=SkyConfig)

    @classmethod
    def sfm_only(cls) -> InitialConfig:
        """SfM points only, as in 3DGS."""
        return cls(DepthPointsConfig(points=0), GroundConfig(points=0), SkyConfig(points=0))


@dataclass(frozen=True)
class LearningRate:
    """A learning rate that decays exponentially.

    Attributes:
        start: Learning rate at the first step.
        decay: Ratio of the last step's learning rate to the first one's; 1 keeps the rate constant.
    """

    start: float
    decay: float = 1.0


@dataclass(frozen=True)
class MemoryUse:
    """Memory for training besides decoded photos, in bytes; measured by `benchmarks/memory.py`.

    Attributes:
        per_gaussian: Bytes per Gaussian: parameters, gradients, Adam's moments, the copies made by densification,
            and intermediate results of one view.
        per_pixel: Bytes per pixel of the largest training image.
        fixed: Networks with Adam's moments and activations, and compiled kernels.
    """

    per_gaussian: int
    per_pixel: int
    fixed: int


@dataclass(frozen=True)
class WildGSRates:
    """Learning rates of networks and intrinsic features.

    Attributes:
        intrinsic: Initial learning rate of intrinsic features.
        networks: Initial learning rate of all networks except the encoder.
        encoder: Initial learning rate of the encoder. At the networks' rate most of its ReLUs die within a few
            thousand steps, and all photos get the same embedding.
        decay: Ratio of the final to the initial learning rate of all three; the decay is exponential.
    """

    intrinsic: float = 2.5e-3
    networks: float = 1e-3
    encoder: float = 1e-4
    decay: float = 0.1


@dataclass(frozen=True)
class CameraResponseConfig:
    """The camera's response beside exposure and white balance (`wildgs.model.camera_response`). Not in the paper.

    Attributes:
        vignetting: Fit a gain that depends on the distance from the optical axis to every photo.
        curve: Fit a tone curve per channel to every photo.
    """

    vignetting: bool = False
    curve: bool = False

    @property
    def fits(self) -> bool:
        """Whether anything is fitted."""
        return self.vignetting or self.curve


@dataclass(frozen=True)
class WildGSConfig:
    """Wild-GS.

    Attributes:
        without: Parts to leave out, for ablations; crop, reverse and local need --local-embeddings.
        mask_threshold: Threshold Th: pixels with a higher visibility are static (used by lifting and depth loss).
        parsing: 2D Parsing.
        local_embeddings: Give every Gaussian a local embedding of the photo by 3D Wrapping, as in the paper. By
            default --light-codes represent lighting that varies over the scene.
        wrapping: 3D Wrapping.
        fusion: The fusion network.
        depth_points: Initial Gaussians on surfaces that depth maps show but SfM has no points on.
        ground: Initial Gaussians that extend the ground plane.
        sky: Initial Gaussians of the sky.
        color_match: After embedding a photo, fit a colour transform between the render under that embedding and the
            photo, and apply it to the scene's colours. Not in the paper.
        matched_loss: Fraction of the colour match that is applied to a training render before the loss, 0 to 1. Not
            in the paper.
        camera_response: Vignetting and tone curve of a photo, fitted after the colour match. Not in the paper.
        light_codes: Light codes per Gaussian, linear in its intrinsic feature, by which a photo's colour transform
            varies over the scene; 0 = none. Not in the paper.
        light_components: Components of the light basis in which a photo's light is fitted after the colour match
            (`wildgs.model.light_basis`); 0 = none. Not in the paper.
        embedding_noise: Relative standard deviation of random noise on the global embedding in training, so that
            the networks do not memorise the light of single photos; 0.2 helps some long runs. Not in the paper.
        embedding_scale: Factor on the global embedding when a photo is encoded for the colour match, 0 to 1, since
            long training memorises the embeddings of training photos. Not in the paper.
        eps2d: Added to the diagonal of projected 2D covariances, in square pixels. 3DGS uses 0.3, which blurs
            pixel-sized detail.
        antialiased: Compensate for `eps2d` in opacities (gsplat's antialiased mode), so that renders of other sizes
            than the training photos' keep their sharpness and thin structures. Not in the paper.
        learning_rates: Learning rates of networks and intrinsic features.
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
    camera_response: CameraResponseConfig = field(default_factory=CameraResponseConfig)
    light_codes: int = 16
    light_components: int = 32
    embedding_noise: float = 0.0
    embedding_scale: float = 0.5
    eps2d: float = 0.1
    antialiased: bool = True
    learning_rates: WildGSRates = field(default_factory=WildGSRates)

    def __post_init__(self) -> None:
        """Rejects ablations of parts that are off."""
        absent = [part for part in WRAPPING_PARTS if part in self.without]
        if absent and not self.local_embeddings:
            raise UserError(
                f"--without {', '.join(absent)}: this is a part of 3D Wrapping, which is off; "
                "add --local-embeddings or --preset paper"
            )


@dataclass(frozen=True)
class VanillaRates:
    """Learning rates of the spherical harmonics, as in 3DGS.

    Attributes:
        sh0: Learning rate of degree 0.
        shN: Learning rate of higher degrees.
    """

    sh0: float = 2.5e-3
    shN: float = 1.25e-4  # noqa: N815 - the field's name


@dataclass(frozen=True)
class VanillaConfig:
    """Plain 3D Gaussian Splatting.

    Attributes:
        learning_rates: Learning rates of the spherical harmonics.
    """

    learning_rates: VanillaRates = field(default_factory=VanillaRates)


@dataclass(frozen=True)
class DropoutConfig:
    """Dropout of Gaussians that few photos show (`wildgs.model.dropout`). Not in the paper.

    Attributes:
        rate: Dropout rate of Gaussians that at most a quarter of --dropout.photos show. 0 = off.
        photos: Gaussians that this many training photos show are not dropped; the rate falls linearly up to it.
        neighbours: Number of neighbouring Gaussians that are dropped together.
    """

    rate: float = 0.2
    photos: int = 12
    neighbours: int = 8
