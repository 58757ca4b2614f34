"""Per-photo embeddings and affine colours, in the manner of WildGaussians (Kulhanek et al. 2024).

Every training photo and every Gaussian has a learnt embedding. A small MLP maps both and the Gaussian's base colour
to a scale and an offset of the Gaussian's colours, as in WildGaussians; gsplat's appearance option is similar but
predicts an offset only. The embedding of a new photo is optimised by a few steps of gradient descent with the scene
fixed, as in NeRF-W and WildGaussians.

The method uses neither masks nor depth.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from wildgs.errors import UserError
from wildgs.geometry.camera import Camera
from wildgs.geometry.spherical_harmonics import rgb_to_sh0
from wildgs.losses.photometric import masked_photometric
from wildgs.model.appearance import Appearance, Embeddings
from wildgs.model.config import InitialConfig, LearningRate, MemoryUse
from wildgs.model.gaussians import GEOMETRY_ROWS, Gaussians, take_rows
from wildgs.model.initial import InitialGaussians
from wildgs.model.method import Method
from wildgs.model.training_pass import ParameterGroup, Stage, TrainingOutput
from wildgs.rasterize import blend

FOURIER_ENTRIES = 6
"""Entries of a Gaussian's embedding per frequency: sine and cosine along three axes."""
OUTPUT_SCALE = 0.1
"""Factor on the output layer's initial weights, so that training starts near the base colours."""


@dataclass(frozen=True)
class AffineRates:
    """Learning rates of harmonics, embeddings and the MLP.

    Attributes:
        sh0: Learning rate of SH degree 0.
        shN: Learning rate of higher SH degrees.
        gaussians: Learning rate of the Gaussians' embeddings.
        photos: Initial learning rate of the photos' embeddings.
        network: Initial learning rate of the MLP.
        decay: Ratio of the final to the initial learning rate of `photos` and `network`; the decay is exponential.
    """

    sh0: float = 2.5e-3
    shN: float = 1.25e-4  # noqa: N815 - the field's name
    gaussians: float = 5e-3
    photos: float = 1e-2
    network: float = 1e-3
    decay: float = 0.1


@dataclass(frozen=True)
class AffineConfig:
    """Per-photo embeddings and affine colours.

    Attributes:
        photo_size: Length of a photo's embedding.
        gaussian_size: Length of a Gaussian's embedding; a multiple of 6.
        hidden: Width of the MLP's two hidden layers.
        sh_degree: Degree of the spherical harmonics of the base colours.
        encode_steps: Adam steps that fit the embedding of a new photo.
        encode_rate: Initial learning rate of these steps, with cosine decay to zero.
        initial: Initial Gaussians in addition to those on SfM points.
        learning_rates: Learning rates of harmonics, embeddings and the MLP.
    """

    photo_size: int = 32
    gaussian_size: int = 24
    hidden: int = 64
    sh_degree: int = 1
    encode_steps: int = 64
    encode_rate: float = 0.1
    initial: InitialConfig = field(default_factory=InitialConfig)
    learning_rates: AffineRates = field(default_factory=AffineRates)

    def __post_init__(self) -> None:
        """Validates the sizes."""
        if self.gaussian_size < FOURIER_ENTRIES or self.gaussian_size % FOURIER_ENTRIES:
            raise UserError(f"gaussian_size {self.gaussian_size}: must be a multiple of {FOURIER_ENTRIES}")
        if min(self.photo_size, self.hidden) < 1 or self.encode_steps < 0:
            raise UserError("photo_size and hidden must be 1 or more, and encode_steps 0 or more")
        if not 0 <= self.sh_degree <= 3:
            raise UserError(f"sh_degree {self.sh_degree}: must be between 0 and 3")


class AffineGS(Method):
    """Gaussians whose base colours are scaled and shifted depending on a photo's embedding."""

    name: ClassVar[str] = "affine"
    label: ClassVar[str] = "Affine colours"
    Config: ClassVar[type] = AffineConfig
    memory: ClassVar[MemoryUse] = MemoryUse(per_gaussian=5000, per_pixel=300, fixed=100 * 2**20)
    config: AffineConfig
    photo_keys: Int[Tensor, " P"]

    def __init__(self, config: AffineConfig, gaussians: Gaussians, photo_keys: Int[Tensor, " P"]) -> None:
        """Creates the method.

        Args:
            config: Configuration.
            gaussians: Gaussians with the rows sh0, shN and embedding.
            photo_keys: Keys of the training photos (`_key`).
        """
        super().__init__()
        self.config = config
        self.gaussians = gaussians
        self.sh_degree = config.sh_degree
        self.global_size = config.photo_size
        self.register_buffer("photo_keys", photo_keys)
        self._places: dict[int, int] | None = None
        self.photo_embeddings = nn.Parameter(torch.zeros(len(photo_keys), config.photo_size))
        self.from_photo = nn.Linear(config.photo_size, config.hidden)
        self.from_gaussian = nn.Linear(config.gaussian_size + 3, config.hidden, bias=False)
        self.hidden = nn.Linear(config.hidden, config.hidden)
        self.output = nn.Linear(config.hidden, 6)
        with torch.no_grad():
            self.output.weight.mul_(OUTPUT_SCALE)
            self.output.bias.zero_()

    @classmethod
    def rows(cls, config: AffineConfig) -> dict[str, tuple[int, ...]]:
        """Geometry, harmonics and the Gaussians' embeddings."""
        harmonics = {"sh0": (1, 3), "shN": ((config.sh_degree + 1) ** 2 - 1, 3)}
        return GEOMETRY_ROWS | harmonics | {"embedding": (config.gaussian_size,)}

    @classmethod
    def initial(cls, config: AffineConfig) -> InitialConfig:
        """The configured initial Gaussians, by default those of Wild-GS."""
        return config.initial

    @classmethod
    def create(cls, config: AffineConfig, initial: InitialGaussians) -> AffineGS:
        """Initialises base colours from the points and embeddings from Fourier features of the positions."""
        low, high = initial.points.quantile(0.02, dim=0), initial.points.quantile(0.98, dim=0)
        places = (initial.rows["means"] - low) / (high - low).clamp_min(1e-6)
        frequencies = 2.0 ** torch.arange(config.gaussian_size // FOURIER_ENTRIES)
        angles = (math.pi * places.clamp(-1, 2)[:, :, None] * frequencies).flatten(1)
        rows = {
            "sh0": rgb_to_sh0(initial.colors)[:, None],
            "shN": torch.zeros(len(places), *cls.rows(config)["shN"]),
            "embedding": torch.cat([angles.sin(), angles.cos()], dim=1),
        }
        keys = torch.tensor([_key(name) for name in initial.photos], dtype=torch.int64)
        return cls(config, Gaussians(initial.rows | rows), keys)

    @classmethod
    def blank(cls, config: AffineConfig, gaussians: Gaussians, state: Mapping[str, Tensor]) -> AffineGS:
        """Creates an untrained method for the checkpoint's number of photos."""
        return cls(config, gaussians, torch.zeros_like(state["photo_keys"]))

    def row_rates(self) -> dict[str, LearningRate]:
        """Learning rates of harmonics and embeddings."""
        rates = self.config.learning_rates
        return {
            "sh0": LearningRate(rates.sh0),
            "shN": LearningRate(rates.shN),
            "embedding": LearningRate(rates.gaussians),
        }

    def parameter_groups(self) -> list[ParameterGroup]:
        """The photos' embeddings, and the MLP."""
        rates = self.config.learning_rates
        layers = (self.from_photo, self.from_gaussian, self.hidden, self.output)
        network = [parameter for layer in layers for parameter in layer.parameters()]
        return [
            ParameterGroup("photos", [self.photo_embeddings], LearningRate(rates.photos, rates.decay)),
            ParameterGroup("network", network, LearningRate(rates.network, rates.decay)),
        ]

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
        """The learnt embedding of a training photo; an optimised one for any other photo."""
        learnt = self._learnt(name)
        return Appearance(self._fit(photo, camera, keep) if learnt is None else learnt)

    def _learnt(self, name: str | None) -> Float[Tensor, " G"] | None:
        """The embedding of a training photo; None for any other photo."""
        if name is None:
            return None
        if self._places is None:  # read once, since every read synchronises with a GPU
            self._places = {key: place for place, key in enumerate(self.photo_keys.tolist())}
        place = self._places.get(_key(name))
        return None if place is None else self.photo_embeddings[place]

    def _mean(self) -> Float[Tensor, " G"]:
        """The mean embedding of the training photos."""
        if len(self.photo_embeddings) == 0:
            return self.photo_embeddings.new_zeros(self.global_size)
        return self.photo_embeddings.mean(dim=0)

    def _fit(
        self, photo: Float[Tensor, "H W 3"], camera: Camera, keep: Bool[Tensor, "H W"] | None
    ) -> Float[Tensor, " G"]:
        """Optimises the embedding of a photo with the scene fixed."""
        embedding = self._mean().detach().clone().requires_grad_()
        optimizer = torch.optim.Adam([embedding], lr=self.config.encode_rate)
        visibility = None if keep is None else keep.to(photo)
        with torch.no_grad():
            projection = self.gaussians.project(camera)
        for step in range(self.config.encode_steps):
            share = step / self.config.encode_steps
            optimizer.param_groups[0]["lr"] = self.config.encode_rate * 0.5 * (1 + math.cos(math.pi * share))
            with torch.enable_grad():
                colors = self.paint(projection, Appearance(embedding), self.sh_degree)
                render = blend(projection, colors, depth=False).colors
                loss = masked_photometric(photo, render, visibility)
                (embedding.grad,) = torch.autograd.grad(loss, [embedding])
            optimizer.step()
        return embedding.detach()

    def fuse(self, embeddings: Embeddings, rows: Int[Tensor, " V"] | None = None) -> Float[Tensor, "N K 3"]:
        """Scales and shifts the base harmonics: colours ``c`` become ``scale * c + offset``."""
        stored = self.gaussians.rows
        parts = [stored["sh0"], stored["shN"], stored["embedding"]]
        flat, higher, own = parts if rows is None else [take_rows(part, rows) for part in parts]
        hidden = self.from_gaussian(torch.cat([own, flat[:, 0]], dim=1))
        hidden = (hidden + self.from_photo(embeddings.global_embedding)).relu()
        scale, offset = self.output(self.hidden(hidden).relu()).chunk(2, dim=1)
        scale = 1 + scale
        # SH colours are relative to grey (0.5), which scale and offset change as well.
        moved = scale * flat[:, 0] + rgb_to_sh0(0.5 * scale + offset)
        return torch.cat([moved[:, None], scale[:, None] * higher], dim=1)

    def training_pass(
        self,
        photo: Float[Tensor, "H W 3"],
        camera: Camera,
        stage: Stage,
        keep: Bool[Tensor, "H W"] | None = None,
        *,
        name: str | None = None,
    ) -> TrainingOutput:
        """Renders under the photo's embedding; photos added when resuming use the mean embedding."""
        learnt = self._learnt(name)
        projection = self.gaussians.project(camera, absgrad=stage.absgrad)
        projection.means2d.retain_grad()
        appearance = Appearance(self._mean() if learnt is None else learnt)
        colors = self.paint(projection, appearance, stage.sh_degree)
        return TrainingOutput(blend(projection, colors), projection, None, colors)


def _key(name: str) -> int:
    """An integer that identifies a photo by its name, since checkpoints hold tensors only."""
    return int.from_bytes(
        hashlib.sha256(name.encode("utf-8", "surrogateescape")).digest()[:8], "big", signed=True
    )
