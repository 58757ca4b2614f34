"""The colour match of a render with its photo: where the sky is, what the light codes are, and which pixels count.

`wildgs.model.color_match` has the least squares; `encode` keeps what is found, training compares with it.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from wildgs.model.color_match import SKY_COLUMNS, changed_harmonics, changed_picture, match_photo
from wildgs.model.config import WildGSConfig
from wildgs.model.sky import Sky, find_sky
from wildgs.rasterize import Projection, Rendering, blend


class PhotoMatch(nn.Module):
    """Finds and applies changes of colours.

    Attributes:
        codes: Gives every Gaussian its light codes, from its intrinsic feature; None for a match that has none.
    """

    def __init__(self, config: WildGSConfig) -> None:
        """Sets up a `PhotoMatch`.

        Args:
            config: The method's.
        """
        super().__init__()
        self.config = config
        self.codes = None
        if config.light_codes and "intrinsic" not in config.without:
            self.codes = nn.Linear(config.fusion.intrinsic_size, config.light_codes, bias=False)

    @property
    def num_codes(self) -> int:
        """Light codes of a Gaussian."""
        return 0 if self.codes is None else self.codes.out_features

    @property
    def columns(self) -> int:
        """Columns of a change: [A | b] and the light codes' of the landmark, and the sky's."""
        return 4 + self.num_codes + (SKY_COLUMNS if self.config.sky.points else 0)

    def light_codes(self, intrinsic: Float[Tensor, "N I"]) -> Float[Tensor, "N L"]:
        """What the change of colours may depend on, from Gaussian to Gaussian."""
        return intrinsic[:, :0] if self.codes is None else self.codes(intrinsic)

    def sky(self, points: Float[Tensor, "*batch 3"], centre: Float[Tensor, " 3"]) -> Sky | None:
        """What is sky among points of a scene with this centre; None where there is none."""
        return find_sky(self.config.sky, points.detach(), centre)

    @torch.no_grad()
    def find(
        self,
        photo: Float[Tensor, "H W 3"],
        projection: Projection,
        colors: Float[Tensor, "N 3"],
        intrinsic: Float[Tensor, "N I"],
        centre: Float[Tensor, " 3"],
        visibility: Float[Tensor, "H W"] | None,
        keep: Bool[Tensor, "H W"] | None,
    ) -> Float[Tensor, "3 M"]:
        """The change that takes the scene's colours to those of a photo.

        Args:
            photo: RGB in [0, 1].
            projection: The Gaussians as the photo's camera sees them.
            colors: Of the Gaussians.
            intrinsic: f^in.
            centre: Of the scene.
            visibility: M.
            keep: The user's own mask: pixels that are False do not count.
        """
        rendering, codes = self._blend(projection, colors, intrinsic)
        sky = self.sky(projection.camera.unproject(rendering.depth), centre)
        threshold = self.config.mask_threshold
        return match_photo(photo, rendering, visibility, keep, threshold=threshold, sky=sky, codes=codes)

    def harmonics(
        self,
        harmonics: Float[Tensor, "V K 3"],
        change: Float[Tensor, "3 M"],
        means: Float[Tensor, "V 3"],
        intrinsic: Float[Tensor, "V I"],
        centre: Float[Tensor, " 3"],
    ) -> Float[Tensor, "V K 3"]:
        """The harmonics of changed colours."""
        return changed_harmonics(harmonics, change, self.sky(means, centre), self.light_codes(intrinsic))

    def training_render(
        self,
        photo: Float[Tensor, "H W 3"],
        projection: Projection,
        colors: Float[Tensor, "N 3"],
        intrinsic: Float[Tensor, "N I"],
        centre: Float[Tensor, " 3"],
        visibility: Float[Tensor, "H W"] | None,
        keep: Bool[Tensor, "H W"] | None,
    ) -> Rendering:
        """The render that the loss compares with a photo; no gradient reaches the match itself. See `find`."""
        share = self.config.matched_loss
        if not (self.config.color_match and share):
            return blend(projection, colors)
        rendering, codes = self._blend(projection, colors, intrinsic)
        threshold = self.config.mask_threshold
        with torch.no_grad():
            sky = self.sky(projection.camera.unproject(rendering.depth), centre)
            change = share * match_photo(
                photo, rendering, visibility, keep, threshold=threshold, sky=sky, codes=codes, training=True
            )
        return replace(rendering, colors=changed_picture(rendering.colors, change, sky, codes))

    def _blend(
        self, projection: Projection, colors: Float[Tensor, "N 3"], intrinsic: Float[Tensor, "N I"]
    ) -> tuple[Rendering, Float[Tensor, "H W L"]]:
        """A rendering, and the light codes in its pixels."""
        rendering = blend(projection, torch.cat([colors, self.light_codes(intrinsic)], dim=1))
        return replace(rendering, colors=rendering.colors[..., :3]), rendering.colors[..., 3:]
