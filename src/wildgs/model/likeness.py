"""Which parts of a photo tell its light: those that do not differ from the render in colour and structure alike.

Not in the paper. Light codes that are fitted to a whole photo represent a coach, too: columns become green below
its roof, and dark at dusk. Under such a light the render differs little from the photo, so that no mask is learnt
there. Edges and patterns hardly depend on the light, and a coach hides them.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from wildgs.losses.evidence import SAME_STRUCTURE, color_distance, correlation_of, exceeding

LEAST = 0.2
"""Smallest weight, so that a photo of which nothing is known yet has a light."""
ROUNDS, OUTLIER = 3, 0.05
"""Iterations of reweighted least squares for gain and offset, and the residual at which a weight is halved."""
RIDGE = 3e-4
"""Ridge regularisation towards a gain of 1, in units of squared colour."""


@torch.no_grad()
def likeness(
    photo: Float[Tensor, "P 3"],
    render: Float[Tensor, "P 3"],
    weights: Float[Tensor, " P"],
    tiles: Int[Tensor, " P"],
    count: int,
) -> Float[Tensor, " P"]:
    """Factors on the weights of pixels in a fit of the light, from `LEAST` to 1, the same within a tile.

    They are low where a tile differs in structure (correlation of grey values below `SAME_STRUCTURE`) and, after
    gain and offset of each channel, in colour: trees and water differ in structure without being something else.

    Args:
        photo: RGB in [0, 1] of a sample of pixels.
        render: The render without light codes.
        weights: Weights of the pixels, 0 for those that do not count.
        tiles: Index of each pixel's tile.
        count: Number of tiles.
    """
    render = render.clamp(0, 1)
    difference = photo - _matched(photo, render, weights)
    grey = torch.stack([photo, render], dim=1).mean(dim=2)
    p, r = (grey - 0.5).unbind(dim=1)  # for the precision of differences of squares
    values = torch.stack([*difference.unbind(dim=1), p, r, p.square(), r.square(), p * r])
    counted = (weights > 0).to(photo.dtype)
    sums = values.new_zeros(len(values) + 1, count)
    sums.index_add_(1, tiles, torch.cat([values, torch.ones_like(p)[None]]) * counted)
    means = sums[:-1] / sums[-1].clamp_min(1)
    distance = color_distance(means[:3], dim=0)[0, tiles]
    usual = torch.where(weights > 0, distance, torch.nan).nanmedian()
    strange = exceeding(distance, usual).nan_to_num(0.0)
    unlike = 1 - (correlation_of(means[3:])[tiles] / SAME_STRUCTURE).clamp(0, 1)
    return 1 - (1 - LEAST) * strange * unlike


def _matched(
    photo: Float[Tensor, "P 3"], render: Float[Tensor, "P 3"], weights: Float[Tensor, " P"]
) -> Float[Tensor, "P 3"]:
    """The render with gain and offset of each channel, by robust least squares."""
    matched, trusted = render, weights
    for _ in range(ROUNDS):
        share = (trusted / trusted.sum().clamp_min(1e-6))[:, None]
        means = (share * photo).sum(dim=0), (share * render).sum(dim=0)
        p, r = photo - means[0], render - means[1]
        gain = ((share * p * r).sum(dim=0) + RIDGE) / ((share * r.square()).sum(dim=0) + RIDGE)
        matched = means[0] + gain * r
        trusted = weights / (1 + ((photo - matched).abs().mean(dim=1) / OUTLIER).square())
    return matched
