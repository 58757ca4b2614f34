"""The sky in directions that a photo does not show: colours like those of the sky that it shows.

Not in the paper. What a network predicts for these directions comes from other photos, and the longer it is
trained, the more of their skies it remembers: blue under a photo taken at dusk, pink beside a pale blue sky. There,
a colour may differ from the mean colour of its elevation only as the photo's own sky does, from cloud to blue.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from wildgs.geometry.spherical_harmonics import rgb_to_sh0, sh_values

COLUMNS, EARLIER_COLUMNS = 9, 5
"""Columns of a sky profile, now and in earlier versions, which had no palette."""
MARGIN, FADE = math.radians(15), math.radians(35)
"""Angle beyond the directions that the photo shows in which the network is trusted, and further angle until the
profile counts fully. Beside a photo's frame the network is right more often."""
HORIZON, FREE = 0.02, 0.15
"""Sines of the elevations between which the profile starts to count. Below is ground, water or haze."""
LEAST_PIXELS = 64
"""Smallest number of sky pixels for a profile."""
RIDGE = torch.tensor([0.0, 3e-4, 3e-4])
"""Ridge on the constant, the slope and the curvature."""
PRIOR_SINES, PRIOR_WEIGHT = torch.linspace(0, 1, 6), 2e-3
"""Sines of elevations at which the sky is assumed to have its usual colour, and weight of this assumption relative
to the photo's sky pixels."""
ROUNDS, OUTLIER = 6, 0.05
"""Iterations of reweighted least squares, and the residual at which a weight is halved (clouds, people, poles)."""
MOST_PIXELS = 20_000
"""Pixels that are used at most."""
SHOWN = 0.05
"""Quantile of the cosines of sky pixels with their mean direction from which on directions count as shown; likewise
of the elevations, at both ends."""
RANGE = 0.05
"""Quantile of the colours' deviations from the polynomial at both ends of the palette."""


@torch.no_grad()
def fit_sky_profile(
    colors: Float[Tensor, "P 3"], directions: Float[Tensor, "P 3"]
) -> Float[Tensor, "3 9"] | None:
    """The colours of a photo's sky by elevation, and the directions in which it shows the sky.

    The colour is a quadratic polynomial of the sine of the elevation, fitted by robust least squares to pixels
    above the horizon, and constant beyond the elevations that the photo shows. The palette is a line in the space
    of colours: the direction in which the sky pixels deviate most from the polynomial, and by how much.

    Args:
        colors: Sky pixels, RGB in [0, 1].
        directions: Their directions from the scene's centre in the aligned frame, unit vectors.

    Returns:
        ``[P | m | (cos r, s0, s1) | d | R]``: the coefficients of 1, s and s² for each channel; the mean direction;
        the cosine of the angle r around it, and the sines of the elevations, that the photo shows; the middle of
        the palette relative to the polynomial; and the symmetric matrix whose eigenvalues are half of its length
        along each eigenvector. None if the photo shows too little sky.
    """
    above = directions[:, 2] > HORIZON
    colors, directions = colors[above], directions[above]
    if len(colors) < LEAST_PIXELS:
        return None
    stride = -(-len(colors) // MOST_PIXELS)
    colors, directions = colors[::stride], directions[::stride]
    mean = functional.normalize(directions.mean(dim=0), dim=0)
    sines = directions[:, 2]
    limits = torch.stack(
        [(directions @ mean).quantile(SHOWN), sines.quantile(SHOWN), sines.quantile(1 - SHOWN)]
    )
    polynomial = _polynomial(colors, sines)
    middle, extent = _palette(colors - _powers(sines) @ polynomial.T)
    return torch.cat([polynomial, mean[:, None], limits[:, None], middle[:, None], extent], dim=1)


def _polynomial(colors: Float[Tensor, "P 3"], sines: Float[Tensor, "P"]) -> Float[Tensor, "3 3"]:
    """Coefficients of the colours' polynomial."""
    terms, target = _powers(sines).double(), colors.double()
    prior = _powers(PRIOR_SINES.to(target))
    usual = target.median(dim=0).values.expand(len(prior), 3)
    ridge = RIDGE.to(target).diag_embed() + PRIOR_WEIGHT / len(prior) * prior.T @ prior
    right = PRIOR_WEIGHT / len(prior) * prior.T @ usual
    trusted = torch.ones_like(terms[:, :1])
    found = torch.zeros_like(ridge)
    for _ in range(ROUNDS):
        weighted = (trusted / trusted.sum() * terms).T
        found = torch.linalg.solve(weighted @ terms + ridge, weighted @ target + right)
        error = (target - terms @ found).abs().mean(dim=1, keepdim=True)
        trusted = 1 / (1 + (error / OUTLIER).square())
    return found.T.float()


def _palette(deviations: Float[Tensor, "P 3"]) -> tuple[Float[Tensor, " 3"], Float[Tensor, "3 3"]]:
    """Middle and extent of the line on which most deviations lie.

    A line, because a box around all deviations admits hues that the sky does not have: pink and slate grey between
    the white and the blue of a hazy sky.
    """
    length = deviations.norm(dim=1)
    usual = deviations[length <= length.quantile(1 - RANGE)]
    axis = torch.linalg.eigh(usual.T @ usual).eigenvectors[:, -1]
    along = deviations @ axis
    low, high = along.quantile(RANGE), along.quantile(1 - RANGE)
    return axis * (low + high) / 2, torch.outer(axis, axis) * (high - low) / 2


def with_palette(profile: Float[Tensor, "_ _"]) -> Float[Tensor, "_ _"]:
    """A profile in the current form; that of an earlier version gets a palette of one colour at each elevation."""
    if profile.shape != (3, EARLIER_COLUMNS):
        return profile
    return functional.pad(profile, (0, COLUMNS - EARLIER_COLUMNS))


def complete_sky(
    harmonics: Float[Tensor, "S K 3"], profile: Float[Tensor, "3 9"], directions: Float[Tensor, "S 3"]
) -> Float[Tensor, "S K 3"]:
    """Replaces the colours of sky Gaussians in directions that a photo does not show by the nearest of its palette.

    Args:
        harmonics: Of the sky's Gaussians, relative to grey (0.5), as in `wildgs.rasterize.sh_to_colors`.
        profile: From `fit_sky_profile`, or a weighted mean of several.
        directions: Of these Gaussians from the scene's centre, unit vectors.
    """
    polynomial, mean, (cosine, lowest, highest) = profile[:, :3], profile[:, 3], profile[:, 4]
    sines = directions[:, 2]
    middle = _powers(sines.clamp(lowest, highest)) @ polynomial.T + profile[:, 5]
    reach, axes = torch.linalg.eigh(profile[:, 6:])
    reach = reach.clamp_min(0)
    deviation = ((0.5 + sh_values(harmonics, directions) - middle) @ axes).clamp(-reach, reach)
    colors = middle + deviation @ axes.T
    beyond = _angle(directions @ mean) - _angle(cosine) - MARGIN
    share = _smooth(beyond / FADE) * _smooth((sines - HORIZON) / (FREE - HORIZON))
    plain = torch.zeros_like(harmonics)
    plain[:, 0] = rgb_to_sh0(colors.clamp(0, 1))
    return torch.lerp(harmonics, plain, share[:, None, None])


def _powers(sines: Float[Tensor, "P"]) -> Float[Tensor, "P 3"]:
    return torch.stack([torch.ones_like(sines), sines, sines.square()], dim=1)


def _angle(cosine: Tensor) -> Tensor:
    return cosine.clamp(-1, 1).acos()


def _smooth(x: Tensor) -> Tensor:
    """0 up to 0, 1 from 1, with a smooth transition."""
    x = x.clamp(0, 1)
    return x.square() * (3 - 2 * x)
