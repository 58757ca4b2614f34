"""The interface of a method: its declarations, and how it encodes, shades and renders.

The trainer, the evaluation and all tools work with any `Method`; docs/methods.md explains how to add one.
"""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar

from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor, nn

from wildgs.geometry.camera import Camera
from wildgs.model.appearance import Appearance, Embeddings, blend_embeddings, mean_embeddings
from wildgs.model.camera_response import responded, squared_radius
from wildgs.model.config import InitialConfig, LearningRate, MemoryUse
from wildgs.model.gaussians import Gaussians, rows_to_shade, spread_rows, take_rows
from wildgs.model.initial import InitialGaussians, initial_from_points
from wildgs.model.training_pass import ParameterGroup, SeenPhoto, Stage, TrainingOutput
from wildgs.rasterize import Projection, Rendering, blend, sh_to_colors


class Method(nn.Module, ABC):
    """A set of Gaussians and a model of their colours.

    Attributes:
        name: Name on the command line, in `config.yaml` and in the registry.
        label: Name in tables and on web pages.
        Config: Frozen dataclass of the method's options, the entry `model` of a run's configuration.
        memory: Memory use of training.
        relightable: Whether colours depend on an appearance.
        gaussians: The Gaussians.
        config: An instance of `Config`.
        reset_every: Default of steps between opacity resets, for a run of 30,000 steps; 0 for none.
        density: Default strategy of density control.
        sh_degree: Degree of the spherical harmonics returned by `shade`.
        global_size: Length of the global embedding; 0 for a method that is not relightable.
        local_size: Length of the local embeddings; 0 for a method without them.
        mask_threshold: Threshold Th: pixels with a higher visibility are static.
        masks_become_final: Whether masks are fixed once their decoder is no longer trained.
        flattens_ground: Whether Gaussians near the ground are kept on its plane in training.
        warps_photos: Whether training photos are displaced to where they fit their renders.
        uses_dropout: Whether Gaussians that few photos show are dropped in training (`Stage.dropout`).
        depth_supervised: Whether the depth loss applies to this method.
        sky_depth: Rendered depth below which something is in front of the sky, in units of the aligned frame; 0 for
            a method without Gaussians of the sky, in which nothing is penalised.
    """

    name: ClassVar[str]
    label: ClassVar[str]
    Config: ClassVar[type]
    memory: ClassVar[MemoryUse]
    reset_every: ClassVar[int] = 3000
    density: ClassVar[str] = "classic"
    relightable: ClassVar[bool] = True

    gaussians: Gaussians
    config: Any
    sh_degree: int = 3
    global_size: int = 0
    local_size: int = 0
    mask_threshold: float = 0.5
    masks_become_final: bool = False
    flattens_ground: bool = False
    warps_photos: bool = False
    uses_dropout: bool = False
    depth_supervised: bool = False
    sky_depth: float = 0.0

    @property
    def map_columns(self) -> int:
        """Columns of a colour map."""
        return 4

    @property
    def basis_size(self) -> int:
        """Number of basis weights of an appearance; 0 for a method that fits none."""
        return 0

    @property
    def response_size(self) -> int:
        """Length of the camera response of an appearance; 0 for a method that fits none."""
        return 0

    # Declarations.

    @classmethod
    @abstractmethod
    def rows(cls, config: Any) -> dict[str, tuple[int, ...]]:
        """Names of all per-Gaussian parameters, including `GEOMETRY_ROWS`, and the shapes of one entry."""

    @classmethod
    def initial(cls, config: Any) -> InitialConfig:
        """Initial Gaussians in addition to those on SfM points; by default none."""
        return InitialConfig.sfm_only()

    @classmethod
    @abstractmethod
    def create(cls, config: Any, initial: InitialGaussians) -> Method:
        """Creates an untrained method from initial Gaussians."""

    @classmethod
    @abstractmethod
    def blank(cls, config: Any, gaussians: Gaussians, state: Mapping[str, Tensor]) -> Method:
        """Creates a method for loading a checkpoint, without reading pretrained weights.

        Args:
            config: Configuration.
            gaussians: The checkpoint's Gaussians.
            state: All tensors of the checkpoint, for shapes that only they determine.
        """

    @classmethod
    def from_points(
        cls, config: Any, points: Float[Tensor, "P 3"], colors: UInt8[Tensor, "P 3"], **options: Any
    ) -> Method:
        """Creates an untrained method from SfM points (aligned frame, 8-bit colours), without other priors."""
        return cls.create(config, initial_from_points(cls.initial(config), points, colors), **options)

    @abstractmethod
    def row_rates(self) -> dict[str, LearningRate]:
        """Learning rates of all rows except `GEOMETRY_ROWS`."""

    def parameter_groups(self) -> list[ParameterGroup]:
        """Parameters that are not per-Gaussian, with their learning rates; by default none."""
        return []

    @property
    def num_gaussians(self) -> int:
        """Number of Gaussians, N."""
        return len(self.gaussians)

    def sky(self) -> Bool[Tensor, " N"] | None:
        """Mask of the sky Gaussians; None if the method does not know them."""
        return None

    def growable(self) -> Bool[Tensor, " N"] | None:
        """Mask of the Gaussians that densification may clone, split, reset and prune; None for all."""
        return None

    def place_features(self, photo: Float[Tensor, "H W 3"], name: str) -> Float[Tensor, "C h w"] | None:
        """Features by which photos are compared (`wildgs.priors.consensus`); None for none.

        Args:
            photo: RGB in [0, 1].
            name: Name of the training photo, for caching.
        """
        return None

    # Encode, shade, render.

    def prepare(self, photos: Sequence[Float[Tensor, "_ _ 3"]]) -> None:
        """Initialises from some training photos (RGB in [0, 1]), once before the first step."""

    def final_photos(self) -> int:
        """Upper bound on the number of training photos for `finish`."""
        return 0

    def finish(self, photos: Iterable[SeenPhoto]) -> None:
        """Processes `final_photos` training photos, an even selection, after the last step.

        Args:
            photos: The photos, read one at a time. Empty when training continues: the earlier result is discarded.
        """

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
        """Computes the appearance of a photo; by default none, for a method that is not relightable.

        Args:
            photo: RGB in [0, 1].
            camera: Its camera, of the photo's size.
            keep: The user's mask: False = ignore the pixel.
            name: Name of the photo if it is a complete photo of the scene, for which there may be a learnt
                embedding.
            trust_mask: Whether pixels that the method predicts to be transient are ignored. Not useful for images
                of other scenes, for which the prediction is meaningless.
            explicit: Whether to compute the local appearance, which the first stage of training does not have.
        """
        return Appearance()

    def visibility(self, photo: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W"] | None:
        """The mask M of a photo (RGB in [0, 1]) without the rest of `encode`; None for a method without a mask."""
        return None

    def embed(self, appearance: Appearance, rows: Int[Tensor, " V"] | None = None) -> Embeddings:
        """Converts an appearance to embeddings of the Gaussians; by default the global embedding only.

        Args:
            appearance: From `encode`.
            rows: Indices of the Gaussians; None for all.
        """
        embedding = appearance.global_embedding
        return Embeddings(self.gaussians.means.new_zeros(0) if embedding is None else embedding)

    @abstractmethod
    def fuse(self, embeddings: Embeddings, rows: Int[Tensor, " V"] | None = None) -> Float[Tensor, "N K 3"]:
        """Spherical harmonics of the Gaussians for embeddings.

        Args:
            embeddings: From `embed` with the same `rows`, or a mix of several.
            rows: Indices of the Gaussians; None for all.
        """

    def shade(self, appearance: Appearance, rows: Int[Tensor, " V"] | None = None) -> Float[Tensor, "N K 3"]:
        """Spherical harmonics for an appearance: `embed`, then `fuse`."""
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
        """The neutral appearance: by default the mean of `count` embeddings, read one at a time."""
        return mean_embeddings(parts, count)

    def appearance_parameters(self) -> tuple[str, ...]:
        """Prefixes of the tensors in `state_dict` on which the meaning of embeddings depends; by default all."""
        return ("",)

    def fingerprint(self) -> str:
        """A digest of `appearance_parameters`, which identifies the state for which saved embeddings are valid."""
        digest = hashlib.sha256()
        state = self.state_dict()
        for key in sorted(state):
            if key.startswith(self.appearance_parameters()):
                digest.update(key.encode())
                digest.update(state[key].detach().cpu().contiguous().numpy().tobytes())
        return digest.hexdigest()[:32]

    def paint(
        self, projection: Projection, appearance: Appearance, sh_degree: int, *, clamped: bool = True
    ) -> Float[Tensor, "N 3"]:
        """Colours of the Gaussians that are visible in a camera; zero for all others, which are not shaded.

        Args:
            projection: Projection to the camera.
            appearance: The appearance.
            sh_degree: Evaluated degree of the harmonics.
            clamped: Whether negative colours are clamped, as for display. Fits of colour transforms need unclamped
                colours, since the transforms are applied to harmonics.
        """
        rows = rows_to_shade(projection.visible)
        seen = self.paint_rows(rows, projection.camera, appearance, sh_degree, clamped=clamped)
        return spread_rows(seen, rows, self.num_gaussians)

    def paint_rows(
        self,
        rows: Int[Tensor, " V"],
        camera: Camera,
        appearance: Appearance,
        sh_degree: int,
        *,
        clamped: bool = True,
    ) -> Float[Tensor, "V 3"]:
        """Like `paint`, but for and of the given Gaussians only."""
        means = take_rows(self.gaussians.means, rows)
        return sh_to_colors(means, self.shade(appearance, rows), camera, degree=sh_degree, clamped=clamped)

    def training_pass(
        self,
        photo: Float[Tensor, "H W 3"],
        camera: Camera,
        stage: Stage,
        keep: Bool[Tensor, "H W"] | None = None,
        *,
        name: str | None = None,
    ) -> TrainingOutput:
        """Renders a training photo under its own appearance with gradients; by default under that of `encode`.

        Args:
            photo: RGB in [0, 1].
            camera: Its camera, of the photo's size.
            stage: Stage of the training schedule.
            keep: The user's mask: False = ignore the pixel.
            name: Name of the photo, by which a method may store or cache data for it.
        """
        projection = self.gaussians.project(camera, absgrad=stage.absgrad)
        projection.means2d.retain_grad()
        colors = self.paint(projection, self.encode(photo, camera, keep, name=name), stage.sh_degree)
        return TrainingOutput(blend(projection, colors), projection, None, colors)

    def render(
        self,
        camera: Camera,
        sh: Float[Tensor, "N K 3"],
        *,
        background: Float[Tensor, " 3"] | None = None,
        sh_degree: int | None = None,
        depth: bool = True,
        response: Float[Tensor, " Q"] | None = None,
    ) -> Rendering:
        """Rasterises the Gaussians with given harmonics, as in plain 3DGS.

        Args:
            camera: A camera in the aligned frame; it is moved to the Gaussians' device.
            sh: From `shade` or `fuse`.
            background: Background colour; None is black.
            sh_degree: Evaluated degree of the harmonics; None takes all.
            depth: Whether the expected depth is rendered too.
            response: Response of a photo's camera, applied to the pixels; None is the identity.
        """
        means = self.gaussians.means
        camera = camera.to(means.device)
        projection = self.gaussians.project(camera)
        degree = self.sh_degree if sh_degree is None else sh_degree
        colors = sh_to_colors(means, sh, camera, degree=degree, visible=projection.visible)
        rendering = blend(projection, colors, background=background, depth=depth)
        if response is None:
            return rendering
        return replace(rendering, colors=responded(rendering.colors, squared_radius(camera), response))
