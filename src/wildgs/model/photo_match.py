"""The colour match of a render with its photo: determines sky, light codes and valid pixels.

`wildgs.model.color_match` implements the least squares. `encode` stores the result in the appearance; training
applies it to the render before the loss.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn import functional

from wildgs.geometry.camera import Camera
from wildgs.model.camera_response import (
    ROUNDS,
    TRAINING_ROUNDS,
    fit_response,
    responded,
    sample_distance,
    squared_radius,
    static_weights,
)
from wildgs.model.color_match import (
    SKY_COLUMNS,
    changed_harmonics,
    elevation_powers,
    match_photo,
    split_change,
)
from wildgs.model.config import WildGSConfig
from wildgs.model.gaussians import Gaussians, spread_rows
from wildgs.model.sky import Sky, find_sky, sine_of_elevation
from wildgs.model.wrapping import liftable
from wildgs.rasterize import Projection, Rendering, blend, blend_sample

MATCH_TILES, MATCH_EVERY = 40, 3
"""In training, number of tiles that are rendered for the match, and stride of the pixels used in them."""
FIT_SIDE = 320
"""Longest side, in pixels, at which an encoded photo is matched, since light is of low frequency."""


@dataclass(frozen=True)
class Sight:
    """A photo, and the Gaussians projected to its camera.

    Attributes:
        photo: RGB in [0, 1].
        projection: Projection to the photo's camera.
        visibility: M; None if the whole photo is static.
        keep: The user's mask: False = ignore the pixel.
    """

    photo: Float[Tensor, "H W 3"]
    projection: Projection
    visibility: Float[Tensor, "H W"] | None
    keep: Bool[Tensor, "H W"] | None

    @classmethod
    def reduced(
        cls,
        gaussians: Gaussians,
        photo: Float[Tensor, "H W 3"],
        camera: Camera,
        visibility: Float[Tensor, "H W"] | None,
        keep: Bool[Tensor, "H W"] | None,
    ) -> Sight:
        """Creates a `Sight` reduced to at most `FIT_SIDE` pixels."""
        scale = min(1.0, FIT_SIDE / max(photo.shape[:2]))
        height, width = (max(1, round(side * scale)) for side in photo.shape[:2])
        camera = camera.resized(width, height)
        return cls(
            _resized(photo, height, width),
            gaussians.project(camera),
            None if visibility is None else _resized(visibility, height, width),
            None if keep is None else _resized(keep.float(), height, width) > 0.5,
        )


@dataclass(frozen=True)
class Picture:
    """A rendering with light codes and sky mask.

    Attributes:
        rendering: Colours, depth and alpha.
        codes: Rendered light codes.
        sky: Sky pixels; None for a scene without sky.
        pixels: Rows and columns of the rendered pixels; None for all.
    """

    rendering: Rendering
    codes: Float[Tensor, "*pixels L"]
    sky: Sky | None
    pixels: tuple[Tensor, Tensor] | None


class PhotoMatch(nn.Module):
    """Fits and applies colour transforms.

    Attributes:
        codes: Linear layer from a Gaussian's intrinsic feature to its light codes; None without light codes.
    """

    def __init__(self, config: WildGSConfig) -> None:
        super().__init__()
        self.config = config
        self.codes = None
        if config.light_codes and "intrinsic" not in config.without:
            self.codes = nn.Linear(config.fusion.intrinsic_size, config.light_codes, bias=False)

    @property
    def num_codes(self) -> int:
        """Number of light codes per Gaussian."""
        return 0 if self.codes is None else self.codes.out_features

    @property
    def columns(self) -> int:
        """Number of columns of a transform: [A | b] and light codes of the landmark, and those of the sky."""
        return 4 + self.num_codes + (SKY_COLUMNS if self.config.sky.points else 0)

    @property
    def code_weights(self) -> Float[Tensor, "L I"] | None:
        """The matrix from an intrinsic feature to light codes; None without light codes."""
        return None if self.codes is None else self.codes.weight

    def light_codes(self, intrinsic: Float[Tensor, "N I"]) -> Float[Tensor, "N L"]:
        """Light codes of the Gaussians, by which their transforms vary."""
        return intrinsic[:, :0] if self.codes is None else self.codes(intrinsic)

    def landmark_codes(
        self, intrinsic: Float[Tensor, "N I"], sky: Bool[Tensor, " N"] | None
    ) -> Float[Tensor, "N L"]:
        """Light codes of all Gaussians, 0 for the sky, whose transform has none."""
        codes = self.light_codes(intrinsic)
        return codes if sky is None else torch.where(sky[:, None], 0, codes)

    def sky(self, points: Float[Tensor, "*batch 3"], centre: Float[Tensor, " 3"]) -> Sky | None:
        """Which points of a scene with this centre are sky; None for a scene without sky."""
        return find_sky(self.config.sky, points.detach(), centre)

    @torch.no_grad()
    def picture(
        self,
        projection: Projection,
        values: Float[Tensor, "N C"],
        centre: Float[Tensor, " 3"],
        *,
        training: bool = False,
    ) -> Picture:
        """Renders colours and light codes of the Gaussians, and determines the sky pixels.

        Args:
            projection: Projection of the Gaussians.
            values: Their colours and light codes, concatenated.
            centre: Centre of the scene.
            training: Whether to render a sample of the pixels only.
        """
        if training:
            blended, pixels = blend_sample(projection, values, tiles=MATCH_TILES, every=MATCH_EVERY)
        else:
            blended, pixels = blend(projection, values), None
        colors, codes = blended.colors[..., :3], blended.colors[..., 3:]
        sky = self.sky(projection.camera.unproject(blended.depth, pixels), centre)
        return Picture(Rendering(colors, blended.depth, blended.alpha), codes, sky, pixels)

    def find(self, sight: Sight, picture: Picture, *, training: bool = False) -> Float[Tensor, "3 M"]:
        """The colour transform from a rendering to the photo, without gradient.

        Args:
            sight: The photo.
            picture: The rendering of its camera.
            training: Whether to fit a gain per channel only; see `match_photo`.
        """
        pixels = (...,) if picture.pixels is None else picture.pixels
        return match_photo(
            sight.photo[pixels],
            picture.rendering,
            None if sight.visibility is None else sight.visibility[pixels],
            None if sight.keep is None else sight.keep[pixels],
            threshold=self.config.mask_threshold,
            sky=picture.sky,
            codes=picture.codes,
            training=training,
        )

    def matched(
        self,
        colors: Float[Tensor, "V 3"],
        codes: Float[Tensor, "A L"],
        sky: Float[Tensor, "B 3"],
        rows: Int[Tensor, " V"],
        count: int,
        sight: Sight,
        centre: Float[Tensor, " 3"],
    ) -> Float[Tensor, "V 3"]:
        """Matches colours of Gaussians to a photo in training, as far as `matched_loss` says.

        Args:
            colors: Colours of the landmark's Gaussians, followed by those of the sky.
            codes: Light codes of the landmark's Gaussians.
            sky: Centres of the sky's Gaussians.
            rows: Indices of the Gaussians.
            count: Number of all Gaussians.
            sight: The photo.
            centre: Centre of the scene.
        """
        with torch.no_grad():
            values = torch.cat([colors, functional.pad(codes, (0, 0, 0, len(sky)))], dim=1)
            values = spread_rows(values, rows, count)
            picture = self.picture(sight.projection, values, centre, training=True)
            change = self.config.matched_loss * self.find(sight, picture, training=True)
            elevation = sine_of_elevation(sky, centre)
        return self.changed(colors, change, codes, elevation)

    def changed(
        self,
        colors: Float[Tensor, "V 3"],
        change: Float[Tensor, "3 M"],
        codes: Float[Tensor, "L C"],
        elevation: Float[Tensor, "S"],
    ) -> Float[Tensor, "V 3"]:
        """Applies a transform fitted in training, with a gain per channel, to colours of Gaussians.

        Colours and light codes get gradients. `harmonics` is the counterpart for harmonics.

        Args:
            colors: Colours of the landmark's Gaussians, followed by those of the sky.
            change: From `find`.
            codes: Light codes of the landmark's Gaussians.
            elevation: Sines of the elevations of the sky's Gaussians.
        """
        own, by_code, of_sky, by_elevation = split_change(change, self.num_codes)
        landmark, sky = colors.tensor_split((len(codes),))
        offsets = (
            torch.addmm(own[:, 3], codes, by_code.T) if self.num_codes else own[:, 3].expand_as(landmark)
        )
        landmark = torch.addcmul(offsets, landmark, 1 + own[:, :3].diagonal())
        if len(sky) == 0:
            return landmark
        elevated = torch.addmm(of_sky[:, 3], elevation_powers(elevation), by_elevation.T)
        return torch.cat([landmark, torch.addcmul(elevated, sky, 1 + of_sky[:, :3].diagonal())])

    def harmonics(
        self,
        harmonics: Float[Tensor, "V K 3"],
        change: Float[Tensor, "3 M"],
        intrinsic: Float[Tensor, "V I"],
        sky: Sky | None,
    ) -> Float[Tensor, "V K 3"]:
        """Applies a transform to spherical harmonics.

        Args:
            harmonics: Of the Gaussians, relative to grey.
            change: From `find`.
            intrinsic: Their intrinsic features.
            sky: Which of them are sky; from `sky`.
        """
        return changed_harmonics(harmonics, change, sky, self.light_codes(intrinsic))

    @torch.no_grad()
    def response(self, sight: Sight, rendering: Rendering, *, training: bool = False) -> Tensor:
        """The camera's response that remains between a matched render and its photo, without gradient.

        Args:
            sight: The photo.
            rendering: The render of its camera under its appearance.
            training: Whether to read a sample of the pixels, in fewer iterations.
        """
        every = sample_distance(*sight.photo.shape[:2]) if training else 1
        part = (slice(None, None, every),) * 2
        visibility, keep = (None if x is None else x[part] for x in (sight.visibility, sight.keep))
        static = liftable(visibility, rendering.alpha[part], self.config.mask_threshold)
        return fit_response(
            self.config.camera_response,
            rendering.colors[part],
            sight.photo[part],
            squared_radius(sight.projection.camera, every),
            static_weights(static, visibility, keep),
            rounds=TRAINING_ROUNDS if training else ROUNDS,
        )

    def developed(self, sight: Sight, rendering: Rendering) -> Float[Tensor, "H W 3"] | None:
        """A training render with the response of the photo's camera, as far as `matched_loss` says."""
        if not self.config.camera_response.fits:
            return None
        response = self.config.matched_loss * self.response(sight, rendering, training=True)
        return responded(rendering.colors, squared_radius(sight.projection.camera), response)


def _resized(values: Float[Tensor, "H W *C"], height: int, width: int) -> Float[Tensor, "h w *C"]:
    """Resizes an image with antialiasing."""
    if values.shape[:2] == (height, width):
        return values
    picture = values.reshape(*values.shape[:2], -1).permute(2, 0, 1)[None]
    small = functional.interpolate(picture, size=(height, width), mode="bilinear", antialias=True)
    return small[0].permute(1, 2, 0).reshape(height, width, *values.shape[2:])
