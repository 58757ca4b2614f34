"""Colour match: an affine colour transform between a render and its photo, for exposure and colour cast.

Not in the paper. The encoder, trained on a few dozen photos, only approximates the light of a new photo. NeRF-W and
its successors optimise the embedding of a new photo instead. An affine colour transform is computed in closed form
from one render and gives most of the improvement of such an optimisation.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from wildgs.geometry.spherical_harmonics import rgb_to_sh0
from wildgs.model.sky import Sky
from wildgs.model.wrapping import MIN_ALPHA, liftable
from wildgs.rasterize import Rendering

ROUNDS, TRAINING_ROUNDS = 6, 3
"""Iterations of iteratively reweighted least squares."""
RIDGE = 3e-4
"""Ridge regularisation of the least squares, in units of mean squared colour."""
CODE_RIDGE = 9e-4
"""The same for all but gain and offset in training. With a weaker one, light codes represent some passers-by."""
SKY_RIDGE = 3e-3
"""The same for all but the constant of an encoded photo's sky. A weaker one gave directions that the photo does not
show another hue: pink sky beside a blue one."""
OUTLIER = 0.05
"""Residual at which a pixel's weight is halved (Cauchy weights), for passers-by that the mask has missed."""
LEAST_PIXELS = 64
"""Smallest number of pixels for a match."""

PRIOR_ELEVATIONS = torch.linspace(-1, 1, 9)
"""Sines of elevations at which an encoded photo's sky is assumed not to change, unless the photo shows it."""
PRIOR_SHARE = 0.007
"""Weight of this assumption relative to that of the photo's sky pixels."""

ELEVATION_ORDERS = 2
"""Powers of the sine of the elevation in the sky's transform, since the sky is paler near the horizon."""
SKY_COLUMNS = 4 + ELEVATION_ORDERS
"""Columns of the sky's transform: [A | b] and one for each power."""


def elevation_powers(sine: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch E"]:
    """Factors of the elevation columns of the sky's transform."""
    return torch.stack([sine ** (order + 1) for order in range(ELEVATION_ORDERS)], dim=-1)


def mapped(
    harmonics: Float[Tensor, "V K 3"],
    change: Float[Tensor, "3 4"],
    offset: Float[Tensor, "V 3"] | float = 0.0,
) -> Float[Tensor, "V K 3"]:
    """Spherical harmonics of the colours ``c + A c + b + offset``, given those of c.

    Args:
        harmonics: Relative to grey (0.5), as in `wildgs.rasterize.sh_to_colors`.
        change: [A | b].
        offset: Additional offset of every Gaussian's colour.
    """
    matrix = torch.eye(3, dtype=change.dtype, device=change.device) + change[:, :3]
    flat = rgb_to_sh0(matrix @ torch.full_like(change[:, 3], 0.5) + change[:, 3] + offset)
    turned = harmonics @ matrix.T
    return torch.cat([turned[:, :1] + flat.reshape(-1, 1, 3), turned[:, 1:]], dim=1)


Region = tuple[Float[Tensor, "*pixels"], Float[Tensor, "*pixels _"]]
"""Weights of pixels, and the terms of a transform besides colour at them."""


@torch.no_grad()
def match_photo(
    photo: Float[Tensor, "*pixels 3"],
    rendering: Rendering,
    visibility: Float[Tensor, "*pixels"] | None,
    keep: Bool[Tensor, "*pixels"] | None,
    *,
    threshold: float,
    sky: Sky | None,
    codes: Float[Tensor, "*pixels L"],
    training: bool = False,
) -> Float[Tensor, "3 M"]:
    """Fits the colour transform from a render to its photo, separately for the landmark and the sky.

    A common transform would be dominated by the sky, which covers much of most photos.

    Args:
        photo: RGB in [0, 1].
        rendering: The render of the photo's camera.
        visibility: M; not used for the sky.
        keep: The user's mask: False = ignore the pixel.
        threshold: Threshold Th of static pixels.
        sky: Sky pixels; None fits one transform for all pixels.
        codes: Rendered light codes of the landmark, on which its transform depends linearly; L may be 0.
        training: Fit a gain per channel (a diagonal A) only.

    Returns:
        Transform [A | b | W] of the landmark: colours c become ``c + A c + b + W codes``; with a sky, followed by
        its transform [A | b | E]: ``c + A c + b + E @ elevation_powers(sine)``. Zero if too few pixels are visible.
    """
    static = liftable(visibility, rendering.alpha, threshold)
    covered = rendering.alpha > MIN_ALPHA
    if keep is not None:
        static, covered = static & keep, covered & keep
    weights = static.float() if visibility is None else visibility * static
    ones = torch.ones_like(weights)[..., None]
    regions = [(weights if sky is None else weights * ~sky.which, torch.cat([ones, codes], dim=-1))]
    if sky is not None:
        elevated = torch.cat([ones, elevation_powers(sky.sine)], dim=-1)
        regions.append(((covered & sky.which).float(), elevated))
    colors, fixed = rendering.colors, 0
    if sky is not None and not training:
        colors, photo, regions = _with_prior(colors, photo, regions)
        fixed = len(PRIOR_ELEVATIONS)
    return torch.cat(_fitted(colors, photo, regions, training, fixed), dim=1)


def _with_prior(
    render: Float[Tensor, "*pixels 3"], photo: Float[Tensor, "*pixels 3"], regions: Sequence[Region]
) -> tuple[
    Float[Tensor, "P 3"], Float[Tensor, "P 3"], list[tuple[Float[Tensor, " P"], Float[Tensor, "P _"]]]
]:
    """Appends sky pixels of the mean colour at all elevations, where render and photo agree.

    A photo from above shows no sky, but distant ground, which has the depth of the sky. Without these pixels, the
    transform that matches it would be extrapolated to the sky.
    """
    colors, target = render.reshape(-1, 3), photo.reshape(-1, 3)
    (weights, terms), (above, elevated) = ((w.reshape(-1), t.reshape(-1, t.shape[-1])) for w, t in regions)
    count, total = len(PRIOR_ELEVATIONS), above.sum()
    mean = ((above[:, None] * colors).sum(dim=0) / total.clamp_min(1)).expand(count, 3)
    sines = PRIOR_ELEVATIONS.to(colors)
    prior = torch.cat([torch.ones_like(sines)[:, None], elevation_powers(sines)], dim=-1)
    extended = [
        (
            torch.cat([weights, weights.new_zeros(count)]),
            torch.cat([terms, terms.new_zeros(count, terms.shape[1])]),
        ),
        (torch.cat([above, (PRIOR_SHARE / count * total).expand(count)]), torch.cat([elevated, prior])),
    ]
    return torch.cat([colors, mean]), torch.cat([target, mean]), extended


def changed_harmonics(
    harmonics: Float[Tensor, "V K 3"],
    change: Float[Tensor, "3 M"],
    sky: Sky | None,
    codes: Float[Tensor, "V L"],
) -> Float[Tensor, "V K 3"]:
    """Applies a colour transform to spherical harmonics.

    Args:
        harmonics: Relative to grey (0.5), as in `wildgs.rasterize.sh_to_colors`.
        change: From `match_photo`.
        sky: Sky Gaussians; None as in `match_photo`.
        codes: Light codes of the Gaussians.
    """
    own, by_code, of_sky, by_elevation = split_change(change, codes.shape[1])
    below = mapped(harmonics, own, codes @ by_code.T)
    if sky is None:
        return below
    above = mapped(harmonics, of_sky, elevation_powers(sky.sine) @ by_elevation.T)
    return torch.where(sky.which[:, None, None], above, below)


def split_change(change: Float[Tensor, "3 M"], codes: int) -> tuple[Tensor, ...]:
    """Splits a transform into [A | b] and W of the landmark, and [A | b] and E of the sky."""
    return change.tensor_split((4, 4 + codes, 8 + codes), dim=1)


def _fitted(
    render: Float[Tensor, "*pixels 3"],
    photo: Float[Tensor, "*pixels 3"],
    regions: Sequence[Region],
    training: bool,
    fixed: int = 0,
) -> list[Float[Tensor, "3 _"]]:
    """Robust least squares of photo minus render on the render's colours and further terms.

    In training, A is diagonal. With a full matrix, colours of materials were lost: errors of the render reduce the
    saturation of the fit, so that it is not learnt.

    There is no synchronisation with a GPU, since pixels are weighted instead of selected. All regions (and
    channels, if A is diagonal) are solved in one batch.

    Args:
        render: Rendered colours.
        photo: Colours of the photo.
        regions: For each region, weights of the pixels, and further terms, the first of which is 1.
        training: Whether A is diagonal.
        fixed: Number of last pixels, of `_with_prior`, whose weights are not reduced, whatever their residual. If
            there are any, the second region is the sky of an encoded photo.
    """
    sizes = [further.shape[-1] for _, further in regions]
    weights = torch.stack([weight.reshape(-1) for weight, _ in regions])
    # Regions with fewer terms are padded with zeros, whose coefficients are 0.
    padded = [functional.pad(further, (0, max(sizes) - further.shape[-1])) for _, further in regions]
    further = torch.stack(padded).reshape(len(regions), 1, weights.shape[1], max(sizes))
    colors = render.reshape(-1, 3).clamp(max=1)
    residual = photo.reshape(-1, 3) - colors
    # Axes: regions, channel groups solved together, pixels, terms and residuals.
    parts = (colors.T[..., None], residual.T[..., None]) if training else (colors[None], residual[None])
    sets, own = parts[0].shape[0], parts[0].shape[2]
    sides = (*further.shape[:1], sets, len(colors), -1)
    columns = [parts[0].expand(sides), further.expand(sides), parts[1].expand(sides)]
    counts = weights > 0
    table = torch.where(counts[:, None, :, None], torch.cat(columns, dim=3), 0).double()
    terms, residuals = table[..., :-own], table[..., -own:]
    ridge = RIDGE * torch.eye(terms.shape[3], table.shape[3], dtype=table.dtype, device=table.device)
    if training:
        ridge[own + 1 :] *= CODE_RIDGE / RIDGE
    if fixed:
        ridge = torch.stack([ridge, ridge * SKY_RIDGE / RIDGE])[:, None]
        ridge[1, 0, own, own] = RIDGE
    base = torch.where(counts, weights, 0).double()
    change, trusted = table.new_zeros(()), base
    for round_ in range(rounds := TRAINING_ROUNDS if training else ROUNDS):
        sums = (terms * trusted[:, None, :, None]).mT @ table
        # The weighted sum of the squared constant term is the sum of weights.
        normal = torch.addcdiv(ridge, sums, sums[..., own : own + 1, own : own + 1])
        change = torch.linalg.solve_ex(normal[..., :-own], normal[..., -own:]).result
        if round_ < rounds - 1:
            error = (residuals - terms @ change).abs().mean(dim=(1, 3))
            reduced = base / (1 + (error / OUTLIER).square())
            trusted = torch.cat([reduced[:, : len(colors) - fixed], base[:, len(colors) - fixed :]], dim=1)
    if training:
        found = torch.cat([change[:, :, 0, 0].diag_embed(), change[:, :, 1:, 0]], dim=2)
    else:
        found = change[:, 0].mT
    usable = found.isfinite().flatten(1).all(dim=1) & (counts.sum(dim=1) >= LEAST_PIXELS)
    found = torch.where(usable[:, None, None], found.float(), 0)
    return [each[:, : 3 + size] for each, size in zip(found, sizes, strict=True)]
