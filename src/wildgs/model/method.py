"""The contract of a method: what it declares, and how it encodes, shades and renders.

The trainer, the evaluation and all tools work with any `Method`; docs/methods.md says how to add one.
"""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, ClassVar

from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor, nn

from wildgs.geometry.camera import Camera
from wildgs.model.appearance import Appearance, Embeddings, blend_embeddings, mean_embeddings
from wildgs.model.config import InitialConfig, LearningRate, MemoryUse
from wildgs.model.gaussians import Gaussians, rows_to_shade, spread_rows, take_rows
from wildgs.model.initial import InitialGaussians, initial_from_points
from wildgs.model.training_pass import ParameterGroup, SeenPhoto, Stage, TrainingOutput
from wildgs.rasterize import Projection, Rendering, blend, sh_to_colors


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
        reset_every: Steps between opacity resets in a run of 30,000, where the schedule names none; 0 for none.
        density: Strategy of density control, where the configuration names none.
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
    reset_every: ClassVar[int] = 3000
    density: ClassVar[str] = "classic"
    relightable: ClassVar[bool] = True

    gaussians: Gaussians
    config: Any
    sh_degree: int = 3
    global_size: int = 0
    local_size: int = 0
    mask_threshold: float = 0.5
    depth_supervised: bool = False

    @property
    def map_columns(self) -> int:
        """Columns of a colour map."""
        return 4

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
        """A method at its start, on the first Gaussians and with the scene's points and photos."""

    @classmethod
    @abstractmethod
    def blank(cls, config: Any, gaussians: Gaussians, state: Mapping[str, Tensor]) -> Method:
        """A method into which a checkpoint's tensors are loaded next; reads no pretrained weights.

        `gaussians` have the checkpoint's rows; `state` holds all its tensors, for shapes that only they determine.
        """

    @classmethod
    def from_points(
        cls, config: Any, points: Float[Tensor, "P 3"], colors: UInt8[Tensor, "P 3"], **options: Any
    ) -> Method:
        """A method at its start on SfM points (aligned frame, 8-bit colours), without priors and budget."""
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

    def sky(self) -> Bool[Tensor, " N"] | None:
        """Which Gaussians stand for the sky; None where the method does not tell."""
        return None

    def growable(self) -> Bool[Tensor, " N"] | None:
        """Which Gaussians densification may clone, split, reset and prune; None for all."""
        return None

    # Encode, shade, render.

    def prepare(self, photos: Sequence[Float[Tensor, "_ _ 3"]]) -> None:
        """Looks at some training photos (RGB in [0, 1]) once, before the first step."""

    def final_photos(self) -> int:
        """How many training photos `finish` looks at, at most."""
        return 0

    def finish(self, photos: Iterable[SeenPhoto]) -> None:
        """Looks at `final_photos` training photos, evenly spread, after the last step.

        Args:
            photos: Read one at a time. None where training continues: what was learnt from them is forgotten.
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
        """Reads the appearance of a photo; by default none, for a method that is not relightable.

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
        return Appearance()

    def visibility(self, photo: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W"] | None:
        """M of a photo (RGB in [0, 1]) and nothing else of `encode`; None for a method without a mask."""
        return None

    def embed(self, appearance: Appearance, rows: Int[Tensor, " V"] | None = None) -> Embeddings:
        """Carries an appearance to the Gaussians; by default the global embedding is all there is.

        Args:
            appearance: From `encode`.
            rows: Indices of the Gaussians; None for all.
        """
        embedding = appearance.global_embedding
        return Embeddings(self.gaussians.means.new_zeros(0) if embedding is None else embedding)

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

    def paint(
        self, projection: Projection, appearance: Appearance, sh_degree: int, *, clamped: bool = True
    ) -> Float[Tensor, "N 3"]:
        """Colours of the Gaussians that a camera sees; zero for all others, which are not even shaded.

        Args:
            projection: Of the camera.
            appearance: The light.
            sh_degree: Evaluated degree of the harmonics.
            clamped: Whether colours below black become black, as they are shown. What is to be changed is better
                seen as it is: a change acts on the harmonics.
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
        """As `paint`, of some Gaussians alone."""
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
        """Renders a training photo under its own appearance, with gradients; by default under that of `encode`.

        Args:
            photo: RGB in [0, 1].
            camera: Its camera, of the photo's size.
            stage: Of the training schedule.
            keep: The user's own mask: pixels that are False are not read.
            name: The photo's, by which a method may keep what it learnt or computed of it.
        """
        projection = self.gaussians.project(camera, absgrad=stage.absgrad)
        projection.means2d.retain_grad()
        colors = self.paint(projection, self.encode(photo, camera, keep, name=name), stage.sh_degree)
        return TrainingOutput(blend(projection, colors), projection, None)

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
