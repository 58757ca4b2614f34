"""What corrects a photo's predicted appearance: colour match, light basis, sky and the camera's response."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from jaxtyping import Float
from torch import Tensor

from wildgs.model.appearance import Appearance
from wildgs.model.photo_match import Picture, Sight
from wildgs.model.sky import sky_directions
from wildgs.model.sky_profile import complete_sky, fit_sky_profile
from wildgs.model.training_pass import SeenPhoto
from wildgs.model.wrapping import MIN_ALPHA
from wildgs.rasterize import blend

if TYPE_CHECKING:
    from wildgs.model.wildgs import WildGS


def corrected(model: WildGS, seen: SeenPhoto, appearance: Appearance) -> Appearance:
    """Adds colour match, light basis, sky profile and camera response to a predicted appearance.

    Args:
        model: The method.
        seen: The photo and its camera.
        appearance: The appearance predicted by the networks.
    """
    match = model.photo_match
    sight = Sight.reduced(model.gaussians, seen.photo, seen.camera, appearance.visibility, seen.keep)
    with torch.no_grad():
        colors = model.paint(sight.projection, appearance, model.sh_degree, clamped=False)
        codes = match.landmark_codes(model.gaussians.rows["intrinsic"], model.sky())
        picture = match.picture(sight.projection, torch.cat([colors, codes], dim=1), model.centre)
        change = match.find(sight, picture)
    appearance = model.light_basis.fit(model, sight, replace(appearance, color_map=change))
    if model.config.sky.complete:
        # After the basis, which is fitted to what the photo shows.
        appearance = replace(appearance, sky_profile=sky_profile(sight, picture, model.centre))
    if not model.response_size:
        return appearance
    with torch.no_grad():
        rendering = blend(sight.projection, model.paint(sight.projection, appearance, model.sh_degree))
    return replace(appearance, response=match.response(sight, rendering))


def sky_profile(sight: Sight, picture: Picture, centre: Float[Tensor, " 3"]) -> Float[Tensor, "3 9"] | None:
    """The sky profile of a photo; None for a scene or a photo without sky.

    Args:
        sight: The photo.
        picture: The rendering of its camera, of all pixels.
        centre: Centre of the scene.
    """
    if picture.sky is None:
        return None
    shown = picture.sky.which & (picture.rendering.alpha > MIN_ALPHA)
    if sight.keep is not None:
        shown = shown & sight.keep
    points = sight.projection.camera.unproject(picture.rendering.depth)[shown]
    return fit_sky_profile(sight.photo[shown], sky_directions(points, centre))


def with_sky_beyond(
    model: WildGS,
    harmonics: Float[Tensor, "V K 3"],
    profile: Float[Tensor, "3 9"],
    means: Float[Tensor, "V 3"],
) -> Float[Tensor, "V K 3"]:
    """Harmonics of Gaussians whose sky is completed by a profile; unchanged for a scene without sky.

    Args:
        model: The method.
        harmonics: Relative to grey.
        profile: From `sky_profile`.
        means: Centres of the Gaussians.
    """
    sky = model.photo_match.sky(means, model.centre)
    if sky is None:
        return harmonics
    rows = sky.which.nonzero()[:, 0]
    directions = sky_directions(means.detach()[rows], model.centre)
    return harmonics.index_copy(0, rows, complete_sky(harmonics[rows], profile, directions))
