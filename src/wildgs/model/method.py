"""The contract of a method: what it declares, and how it encodes, shades and renders.

The trainer, the evaluation and all tools work with any `Method`; docs/methods.md says how to add one.
"""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor, nn

from wildgs.geometry.camera import Camera
from wildgs.model.appearance import Appearance, Embeddings, blend_embeddings, mean_embeddings
from wildgs.model.config import InitialConfig, LearningRate
from wildgs.model.gaussians import Gaussians
from wildgs.model.initial import InitialGaussians, initial_from_points
from wildgs.rasterize import Projection, Rendering, blend, sh_to_colors

GEOMETRY_ROWS: dict[str, tuple[int, ...]] = {
    "means": (3,),
    "quats": (4,),
    "log_scales": (3,),
    "opacity_logits": (),
}
"""Rows that every method has, with the shape of one Gaussian's entry."""


@dataclass(frozen=True)
class Stage:
    """The state of the training schedule that a method's forward pass depends on.

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


class Method(nn.Module, ABC):
    """A set of Gaussians and a way to colour them.

    Attributes:
        name: On the command line, in `config.yaml` and in the registry.
        label: In tables and on pages.
        Config: Frozen dataclass of the method's options; it is the entry `model` of a run's configuration.
        memory: What training takes.
        relightable: Whether photos have a say in the colours; if not, there is one light only.
        gaussians: The Gaussians.
        config: An instance of `Config`.
        sh_degree: Degree of the spherical harmonics that `shade` gives.
        global_size: Length of the global embedding; 0 for a method that is not relightable.
        local_size: Length of the local embeddings; 0 for a method that has none.
        mask_threshold: Th: pixels with a visibility above it count as static.
        depth_supervised: Whether the depth loss applies to this method.
    """

    name: ClassVar[str]
    label: ClassVar[str]
    Config: ClassVar[type]
    memory: ClassVar[MemoryUse]
    relightable: ClassVar[bool] = True

    gaussians: Gaussians
    config: Any
    sh_degree: int = 3
    global_size: int = 0
    local_size: int = 0
    mask_threshold: float = 0.5
    depth_supervised: bool = False

    @property
    def basis_size(self) -> int:
        """Number of basis weights of an appearance; 0 for a method that fits none."""
        return 0

    # What a method declares.

    @classmethod
    @abstractmethod
    def rows(cls, config: Any) -> dict[str, tuple[int, ...]]:
        """All per-Gaussian parameters: from the row's name to the shape of one entry; holds `GEOMETRY_ROWS`."""

    @classmethod
    def initial(cls, config: Any) -> InitialConfig:
        """Which first Gaussians the method wants beside those on SfM points; by default none."""
        return InitialConfig.sfm_only()

    @classmethod
    @abstractmethod
    def create(cls, config: Any, initial: InitialGaussians) -> Method:
        """A method at its start.

        Args:
            config: An instance of `Config`.
            initial: The first Gaussians, and the scene's points and photos.
        """

    @classmethod
    @abstractmethod
    def blank(cls, config: Any, gaussians: Gaussians, state: Mapping[str, Tensor]) -> Method:
        """A method into which a checkpoint's tensors are loaded next; reads no pretrained weights.

        Args:
            config: An instance of `Config`.
            gaussians: With the checkpoint's rows.
            state: All of the checkpoint's tensors, for shapes that neither `config` nor `gaussians` determine.
        """

    @classmethod
    def from_points(
        cls, config: Any, points: Float[Tensor, "P 3"], colors: UInt8[Tensor, "P 3"], **options: Any
    ) -> Method:
        """A method at its start on SfM points, without priors and budget.

        Args:
            config: An instance of `Config`.
            points: In the scene's aligned frame.
            colors: Their 8-bit colours.
            options: Passed to `create`.
        """
        return cls.create(config, initial_from_points(cls.initial(config), points, colors), **options)

    @abstractmethod
    def row_rates(self) -> dict[str, LearningRate]:
        """Learning rates of the rows beyond `GEOMETRY_ROWS`, whose rates are the optimiser's own."""

    def parameter_groups(self) -> list[ParameterGroup]:
        """Parameters that are no rows, with their learning rates; by default none."""
        return []

    @property
    def num_gaussians(self) -> int:
        """N."""
        return len(self.gaussians)

    def growable(self) -> Bool[Tensor, " N"] | None:
        """Which Gaussians densification may clone and split; None for all."""
        return None

    # Encode, shade, render.

    def prepare(self, photos: Sequence[Float[Tensor, "_ _ 3"]]) -> None:
        """Looks at some training photos (RGB in [0, 1]) once, before the first step."""

    def finish(self, photos: Iterable[SeenPhoto], count: int) -> None:
        """Looks at the training photos once more, after the last step.

        Args:
            photos: Read one at a time; none where training continues: what was learnt from them is forgotten.
            count: How many there are.
        """

    @abstractmethod
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
        """Reads the appearance of a photo.

        Args:
            photo: RGB in [0, 1].
            camera: Its camera, of the photo's size.
            keep: The user's own mask: pixels that are False are not read.
            name: Its name where it is one of the scene's photos, shown whole: a method may have learnt an
                embedding for it.
            trust_mask: Whether pixels that the method takes for transient are left out too. Not for pictures that
                are no photo of the place: there is nobody in the way, and everything is unusual.
            explicit: Whether local appearance is read; False gives what the first stage of training has.
        """

    def visibility(self, photo: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W"] | None:
        """M of a photo (RGB in [0, 1]) and nothing else of `encode`; None for a method without a mask."""
        return None

    @abstractmethod
    def embed(self, appearance: Appearance, rows: Int[Tensor, " V"] | None = None) -> Embeddings:
        """Carries an appearance to the Gaussians.

        Args:
            appearance: From `encode`; `Appearance()` for a method that is not relightable.
            rows: Indices of the Gaussians; None for all.
        """

    @abstractmethod
    def fuse(self, embeddings: Embeddings, rows: Int[Tensor, " V"] | None = None) -> Float[Tensor, "N K 3"]:
        """Spherical harmonics of the Gaussians under embeddings.

        Args:
            embeddings: From `embed` with the same `rows`, or a mix.
            rows: Indices of the Gaussians; None for all.
        """

    def shade(self, appearance: Appearance, rows: Int[Tensor, " V"] | None = None) -> Float[Tensor, "N K 3"]:
        """Spherical harmonics under an appearance: `embed`, then `fuse`."""
        return self.fuse(self.embed(appearance, rows), rows)

    def mix(
        self,
        parts: Sequence[Embeddings],
        weights: Sequence[float],
        local_weights: Sequence[float] | None = None,
    ) -> Embeddings:
        """Appearance tuning: by default the weighted sum of embeddings; see `blend_embeddings`."""
        return blend_embeddings(parts, weights, local_weights)

    def mean(self, parts: Iterable[Embeddings], count: int) -> Embeddings:
        """The neutral light: by default the mean of `count` embeddings, read one at a time."""
        return mean_embeddings(parts, count)

    def appearance_parameters(self) -> tuple[str, ...]:
        """Prefixes of the tensors in `state_dict` that give embeddings their meaning; by default all."""
        return ("",)

    def fingerprint(self) -> str:
        """Identifies the trained state to which saved embeddings belong: a digest of `appearance_parameters`."""
        digest = hashlib.sha256()
        state = self.state_dict()
        for key in sorted(state):
            if key.startswith(self.appearance_parameters()):
                digest.update(key.encode())
                digest.update(state[key].detach().cpu().contiguous().numpy().tobytes())
        return digest.hexdigest()[:32]

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
            stage: Of the training schedule.
            keep: The user's own mask: pixels that are False are not read.
            name: The photo's, by which a method may keep what it learnt or computed of it.
        """

    def render(
        self,
        camera: Camera,
        sh: Float[Tensor, "N K 3"],
        *,
        background: Float[Tensor, " 3"] | None = None,
        sh_degree: int | None = None,
        depth: bool = True,
    ) -> Rendering:
        """Rasterises the Gaussians under shaded harmonics: plain 3D Gaussian Splatting.

        Args:
            camera: In the aligned frame; it is moved to the Gaussians' device.
            sh: From `shade` or `fuse`.
            background: Its colour; None is black.
            sh_degree: Evaluated degree of the harmonics; None takes all.
            depth: Whether the expected depth is rendered too.
        """
        means = self.gaussians.means
        camera = camera.to(means.device)
        projection = self.gaussians.project(camera)
        degree = self.sh_degree if sh_degree is None else sh_degree
        colors = sh_to_colors(means, sh, camera, degree=degree, visible=projection.visible)
        return blend(projection, colors, background=background, depth=depth)
