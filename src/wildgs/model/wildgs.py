"""The method Wild-GS, which connects the modules of the paper's figure 2."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import ClassVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from wildgs.geometry.camera import Camera
from wildgs.model.appearance import Appearance, Embeddings
from wildgs.model.camera_response import RESPONSE_SIZE
from wildgs.model.config import Ablation, InitialConfig, LearningRate, MemoryUse, WildGSConfig
from wildgs.model.dropout import opacity_factors
from wildgs.model.encoder import Encoder, encoder_of
from wildgs.model.encoding import corrected, with_sky_beyond
from wildgs.model.fusion import Fusion
from wildgs.model.gaussians import (
    GEOMETRY_ROWS,
    Gaussians,
    rows_by_group,
    rows_to_shade,
    spread_rows,
    take_rows,
)
from wildgs.model.initial import InitialGaussians
from wildgs.model.light_basis import LightBasis
from wildgs.model.method import Method
from wildgs.model.parsing import Parsing
from wildgs.model.photo_match import PhotoMatch, Sight
from wildgs.model.sky import SKY_SHARE, is_sky
from wildgs.model.training_pass import ParameterGroup, SeenPhoto, Stage, TrainingOutput
from wildgs.model.triplane import Box, robust_box
from wildgs.model.wrapping import Wrapping, lift, liftable, random_part
from wildgs.rasterize import Projection, blend, sh_to_colors


class WildGS(Method):
    """Gaussians whose colours are predicted from global embedding, local embedding and intrinsic feature."""

    name: ClassVar[str] = "wildgs"
    label: ClassVar[str] = "Wild-GS"
    Config: ClassVar[type] = WildGSConfig
    memory: ClassVar[MemoryUse] = MemoryUse(per_gaussian=6000, per_pixel=700, fixed=600 * 2**20)
    reset_every: ClassVar[int] = 0
    density: ClassVar[str] = "relocation"
    flattens_ground = True
    warps_photos = True
    uses_dropout = True
    config: WildGSConfig

    def __init__(
        self, config: WildGSConfig, gaussians: Gaussians, box: Box, encoder: Encoder | None = None
    ) -> None:
        """Creates the method.

        Args:
            config: Configuration.
            gaussians: Gaussians with a row `intrinsic`.
            box: Bounding box of the triplane.
            encoder: Replaces the configured encoder.
        """
        super().__init__()
        self.config = config
        self.gaussians = gaussians
        gaussians.eps2d, gaussians.antialiased = config.eps2d, config.antialiased
        self.sh_degree = config.fusion.sh_degree
        self.global_size = config.parsing.global_size
        self.local_size = config.wrapping.local_size
        self.mask_threshold = config.mask_threshold
        self.depth_supervised = not self._lacks("depth")
        self.sky_depth = SKY_SHARE * config.sky.radius if config.sky.points else 0.0
        self.parsing = Parsing(config.parsing, encoder)
        self.masks_become_final = self.parsing.encoder.frozen
        self.wrapping = Wrapping(config.wrapping, box, reverse=not self._lacks("reverse"))
        self.fusion = Fusion(config.fusion, config.parsing.global_size, config.wrapping.local_size)
        if config.sky.points and config.sky.own_fusion:
            self.fusion.separate_sky()
        self.light_basis = LightBasis()
        self.photo_match = PhotoMatch(config)

    @classmethod
    def rows(cls, config: WildGSConfig) -> dict[str, tuple[int, ...]]:
        """Geometry and the intrinsic feature f^in."""
        return GEOMETRY_ROWS | {"intrinsic": (config.fusion.intrinsic_size,)}

    @classmethod
    def initial(cls, config: WildGSConfig) -> InitialConfig:
        """Depth points, ground and sky as configured."""
        return InitialConfig(config.depth_points, config.ground, config.sky)

    @classmethod
    def create(
        cls, config: WildGSConfig, initial: InitialGaussians, encoder: Encoder | None = None
    ) -> WildGS:
        """Initialises intrinsic features from the points' colours, and the triplane's box from the SfM points."""
        ratio = 1.0 if "crop" in config.without else config.wrapping.crop_ratio
        box = robust_box(initial.points, config.wrapping.box_quantile, ratio)
        intrinsic = torch.zeros(len(initial.colors), config.fusion.intrinsic_size)
        model = cls(config, Gaussians(initial.rows | {"intrinsic": intrinsic}), box, encoder)
        with torch.no_grad():
            model.gaussians.rows["intrinsic"].copy_(model.fusion.initial_intrinsic(initial.colors))
        if config.local_embeddings:
            model.wrapping.calibrate(initial.points, initial.point_colors)
        return model

    @classmethod
    def blank(cls, config: WildGSConfig, gaussians: Gaussians, state: Mapping[str, Tensor]) -> WildGS:
        """Creates the method with an untrained encoder and an arbitrary box."""
        box = Box(torch.zeros(3), torch.ones(3))
        model = cls(config, gaussians, box, encoder_of(state, "parsing.encoder."))
        if "photo_match.codes.weight" not in state:  # checkpoint of an earlier version
            model.photo_match.codes = None
        model.light_basis.components = state.get("light_basis.components")
        return model

    def growable(self) -> Bool[Tensor, " N"] | None:
        """All Gaussians except the sky, unless `sky.densify` is set."""
        sky = None if self.config.sky.densify else self.sky()
        return None if sky is None else ~sky

    def sky(self) -> Bool[Tensor, " N"] | None:
        """Gaussians far from the scene; see `wildgs.model.sky.is_sky`."""
        if not self.config.sky.points:
            return None
        return is_sky(self.config.sky, self.gaussians.means.detach(), self.centre)

    def row_rates(self) -> dict[str, LearningRate]:
        """Learning rate of f^in."""
        rates = self.config.learning_rates
        return {"intrinsic": LearningRate(rates.intrinsic, rates.decay)}

    def parameter_groups(self) -> list[ParameterGroup]:
        """All networks except the encoder, and the encoder."""
        rates = self.config.learning_rates
        encoder = list(self.parsing.encoder.parameters())
        owned = {id(p) for p in (*encoder, *self.gaussians.parameters())}
        networks = [p for p in self.parameters() if id(p) not in owned]
        return [
            ParameterGroup("networks", networks, LearningRate(rates.networks, rates.decay)),
            ParameterGroup("encoder", encoder, LearningRate(rates.encoder, rates.decay)),
        ]

    def appearance_parameters(self) -> tuple[str, ...]:
        """The fusion network, the centres (at which planes are sampled), light basis and colour match."""
        return ("fusion.", "gaussians.rows.means", "light_basis.", "photo_match.")

    @property
    def map_columns(self) -> int:
        """Columns of a colour map; see `PhotoMatch`."""
        return self.photo_match.columns

    @property
    def basis_size(self) -> int:
        """Number of components of the light basis."""
        return 0 if self.light_basis.components is None else len(self.light_basis.components)

    @property
    def response_size(self) -> int:
        """Length of a camera response."""
        return RESPONSE_SIZE if self.config.color_match and self.config.camera_response.fits else 0

    @property
    def _wraps(self) -> bool:
        return self.config.local_embeddings and not self._lacks("local")

    def _lacks(self, part: Ablation) -> bool:
        return part in self.config.without

    def prepare(self, photos: Sequence[Float[Tensor, "_ _ 3"]]) -> None:
        """Calibrates 2D Parsing."""
        self.parsing.calibrate(photos)

    def final_photos(self) -> int:
        """Number of photos from which the light basis is computed."""
        if not (self.config.color_match and self.config.light_components):
            return 0
        return self.light_basis.affordable_lights(self.num_gaussians, (self.sh_degree + 1) ** 2)

    @torch.no_grad()
    def finish(self, photos: Iterable[SeenPhoto]) -> None:
        """Computes the light basis."""
        self.light_basis.components = None  # otherwise the lights would be fitted in the previous basis
        lights = (self.shade(self._learned_appearance(seen)) for seen in photos)
        self.light_basis.learn(lights, self.gaussians, self.config.light_components)

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
        """Parses the photo, lifts its static pixels by the rendered depth, builds the triplane, matches colours."""
        appearance, seen = self.parse(photo), SeenPhoto(photo, camera, keep, name or "")
        if not explicit:
            return appearance
        appearance = self._wrapped(seen, appearance if trust_mask else replace(appearance, visibility=None))
        # Without trust in the mask, the image shows another scene, so that comparing pixels is meaningless.
        if not (self.config.color_match and trust_mask):
            return appearance
        assert appearance.global_embedding is not None
        embedding = self.config.embedding_scale * appearance.global_embedding
        return corrected(self, seen, replace(appearance, global_embedding=embedding))

    def _learned_appearance(self, seen: SeenPhoto) -> Appearance:
        """`encode` of a training photo with all of its embedding, as in training."""
        appearance = self._wrapped(seen, self.parse(seen.photo))
        return corrected(self, seen, appearance) if self.config.color_match else appearance

    def _wrapped(self, seen: SeenPhoto, appearance: Appearance) -> Appearance:
        """Adds the triplane to an appearance from `parse`, if there are local embeddings."""
        if not self._wraps:
            return appearance
        with torch.no_grad():
            projection = self.gaussians.project(seen.camera)
        return self.wrap(seen.photo, appearance, projection, seen.keep)

    @property
    def centre(self) -> Float[Tensor, " 3"]:
        """Centre of the scene, from which directions of the sky are seen."""
        return (self.wrapping.low + self.wrapping.high) / 2

    def visibility(self, photo: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W"] | None:
        """The mask M, by 2D Parsing only."""
        return self.parse(photo).visibility

    def place_features(self, photo: Float[Tensor, "H W 3"], name: str) -> Float[Tensor, "C h w"] | None:
        """Features of a frozen encoder; None without one or without a mask."""
        if self._lacks("mask") or not self.parsing.encoder.frozen:
            return None
        return self.parsing.place_features(photo, name)

    def parse(
        self,
        photo: Float[Tensor, "H W 3"],
        *,
        learn_encoder: bool = True,
        learn_mask: bool = True,
        name: str | None = None,
    ) -> Appearance:
        """2D Parsing: mask and global embedding; the local embedding is v everywhere."""
        visibility, embedding = self.parsing(
            photo, learn_encoder=learn_encoder, learn_mask=learn_mask, name=name
        )
        if self._lacks("global"):
            embedding = torch.zeros_like(embedding)
        return Appearance(embedding, None, None if self._lacks("mask") else visibility)

    def wrap(
        self,
        photo: Float[Tensor, "H W 3"],
        appearance: Appearance,
        projection: Projection,
        keep: Bool[Tensor, "H W"] | None = None,
        *,
        learn: bool = True,
    ) -> Appearance:
        """3D Wrapping: adds the triplane, from rendered depth without gradient.

        Args:
            photo: RGB in [0, 1].
            appearance: From `parse`.
            projection: Projection of the Gaussians to the photo's camera.
            keep: The user's mask: False = do not lift the pixel.
            learn: Whether U^3D gets gradients.
        """
        with torch.no_grad():
            geometry = blend(projection, None)
            chosen = liftable(appearance.visibility, geometry.alpha, self.mask_threshold)
            if keep is not None:
                chosen = chosen & keep
            points, colors = lift(photo, geometry.depth, projection.camera)
        planes = self.wrapping.planes(points, colors, chosen.reshape(-1), learn=learn)
        return replace(appearance, planes=planes)

    def _lifted_in_training(
        self, photo: Float[Tensor, "H W 3"], keep: Bool[Tensor, "H W"] | None
    ) -> Bool[Tensor, "H W"] | None:
        """The user's mask, in some steps restricted to a random part of the image (`partial_lifts`)."""
        if torch.rand(()) >= self.config.wrapping.partial_lifts:
            return keep
        height, width = photo.shape[:2]
        part = random_part(height, width, photo.device)
        return part if keep is None else keep & part

    def embed(self, appearance: Appearance, rows: Int[Tensor, " V"] | None = None) -> Embeddings:
        """Samples local embeddings at the Gaussians."""
        means = self.gaussians.means if rows is None else take_rows(self.gaussians.means, rows)
        return self._embedded(appearance, means)

    def _embedded(self, appearance: Appearance, means: Float[Tensor, "V 3"]) -> Embeddings:
        """Embeddings of Gaussians with the given centres."""
        assert appearance.global_embedding is not None
        local = self.wrapping.local_embeddings(appearance.planes, means)
        return Embeddings(
            appearance.global_embedding,
            local,
            appearance.color_map,
            appearance.basis_weights,
            appearance.response,
            appearance.sky_profile,
        )

    def fuse(self, embeddings: Embeddings, rows: Int[Tensor, " V"] | None = None) -> Float[Tensor, "N K 3"]:
        """Spherical harmonics sh = M^F(Emb^g ⊕ Emb^l ⊕ f^in) of the given Gaussians, corrected as in `encode`."""
        means, intrinsic = self.gaussians.means, self.gaussians.rows["intrinsic"]
        if rows is not None:
            means, intrinsic = take_rows(means, rows), take_rows(intrinsic, rows)
        harmonics = self._fused(embeddings, means, intrinsic)
        if embeddings.basis_weights is not None:
            harmonics = harmonics + self.light_basis.harmonics(embeddings.basis_weights, rows)
        profile = embeddings.sky_profile
        return harmonics if profile is None else with_sky_beyond(self, harmonics, profile, means)

    def _fused(
        self, embeddings: Embeddings, means: Float[Tensor, "V 3"], intrinsic: Float[Tensor, "V I"]
    ) -> Float[Tensor, "V K 3"]:
        """Spherical harmonics by the fusion network and the colour match."""
        common, local = embeddings.global_embedding, embeddings.local_embeddings
        assert local is not None
        change, sky = embeddings.color_map, self.photo_match.sky(means, self.centre)
        which = None if sky is None else sky.which
        network_input = self._network_input(intrinsic)
        if change is None or change.shape[1] == 4:
            return self.fusion.with_sky(common, local, network_input, which, change)
        harmonics = self.fusion.with_sky(common, local, network_input, which)
        return self.photo_match.harmonics(harmonics, change, intrinsic, sky)

    def _network_input(self, intrinsic: Float[Tensor, "V I"]) -> Float[Tensor, "V I"]:
        """f^in, or zeros in the ablation without it."""
        return torch.zeros_like(intrinsic) if self._lacks("intrinsic") else intrinsic

    def training_pass(
        self,
        photo: Float[Tensor, "H W 3"],
        camera: Camera,
        stage: Stage,
        keep: Bool[Tensor, "H W"] | None = None,
        *,
        name: str | None = None,
    ) -> TrainingOutput:
        """Renders the photo under its own appearance, with one projection for all passes."""
        appearance = self.parse(
            photo, learn_encoder=stage.learn_encoder, learn_mask=stage.learn_mask, name=name
        )
        factors = None if stage.dropout is None else opacity_factors(stage.dropout, stage.neighbours)
        projection = self.gaussians.project(camera, absgrad=stage.absgrad, factors=factors)
        projection.means2d.retain_grad()
        if stage.explicit and self._wraps:
            lifted = self._lifted_in_training(photo, keep)
            appearance = self.wrap(photo, appearance, projection, lifted, learn=stage.learn_planes)
        rows, landmark = self._rows_to_shade(projection.visible)
        means = take_rows(self.gaussians.means, rows)
        embedding = self._with_noise(appearance.global_embedding)
        local = self.wrapping.local_embeddings(appearance.planes, means)
        intrinsic = self._network_input(self.gaussians.rows["intrinsic"])
        harmonics, codes = self.fusion.of_rows(
            embedding, local, intrinsic, rows, landmark, self.photo_match.code_weights
        )
        matched = bool(self.config.color_match and self.config.matched_loss)
        colors = sh_to_colors(means, harmonics, camera, degree=stage.sh_degree, clamped=not matched)
        sight = Sight(photo, projection, appearance.visibility, keep)
        if matched:
            colors = self.photo_match.matched(
                colors, codes, means[landmark:], rows, self.num_gaussians, sight, self.centre
            ).clamp_min(0)
        colors = spread_rows(colors, rows, self.num_gaussians)
        rendering = blend(projection, colors)
        developed = self.photo_match.developed(sight, rendering) if matched else None
        return TrainingOutput(rendering, projection, appearance.visibility, colors, developed)

    def _with_noise(self, embedding: Float[Tensor, " G"] | None) -> Float[Tensor, " G"]:
        """A photo's global embedding in training."""
        assert embedding is not None
        if not self.config.embedding_noise:
            return embedding
        return embedding * (1 + self.config.embedding_noise * torch.randn_like(embedding))

    def _rows_to_shade(self, visible: Bool[Tensor, " N"]) -> tuple[Int[Tensor, " V"], int]:
        """Rows of the landmark's visible Gaussians followed by those of the sky, and the number of the former."""
        sky = self.sky()
        if sky is None:
            rows = rows_to_shade(visible)
            return rows, len(rows)
        return rows_by_group(visible, sky)
