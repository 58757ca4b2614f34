"""Where a photo and a render show the same structure, so that the difference of their colours is light.

Not in the paper. Light codes that are fitted to a whole photo represent a coach, too: columns become green below
its roof, and dark at dusk. Under such a light the render differs little from the photo, so that no mask is learnt
there. Edges and patterns hardly depend on the light, and a coach hides them.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from wildgs.losses.evidence import FLAT, SAME_STRUCTURE, structural_correlation
from wildgs.rasterize import TILE

LEAST = 0.2
"""Weight of pixels with another structure, so that a photo of which nothing is known yet has a light."""


@torch.no_grad()
def likeness(
    photo: Float[Tensor, "*pixels 3"],
    render: Float[Tensor, "*pixels 3"],
    pixels: tuple[Int[Tensor, " P"], Int[Tensor, " P"]] | None,
    height: int,
    width: int,
) -> Float[Tensor, "*pixels"]:
    """Weights of pixels in a fit of the light, from `LEAST` to 1.

    They increase linearly with the correlation of grey values up to `SAME_STRUCTURE`.

    Args:
        photo: RGB in [0, 1]; all pixels, or a sample.
        render: The render, under any light.
        pixels: Rows and columns of the sample, whose pixels are compared within each tile of the rasteriser; None
            for all, each of which is compared in a window around it.
        height: Height of the photo.
        width: Width of the photo.
    """
    if pixels is None:
        correlation = structural_correlation(photo, render)
    else:
        correlation = _tile_correlation(photo, render, pixels, height, width)
    return LEAST + (1 - LEAST) * (correlation / SAME_STRUCTURE).clamp(0, 1)


def _tile_correlation(
    photo: Float[Tensor, "P 3"],
    render: Float[Tensor, "P 3"],
    pixels: tuple[Int[Tensor, " P"], Int[Tensor, " P"]],
    height: int,
    width: int,
) -> Float[Tensor, " P"]:
    """Correlation of grey values in the tile of each pixel; both are assumed to share noise of `FLAT`."""
    rows, columns = -(-height // TILE), -(-width // TILE)
    tiles = pixels[0] // TILE * columns + pixels[1] // TILE
    p, r = photo.mean(dim=1), render.clamp(0, 1).mean(dim=1)
    p, r = p - p.mean(), r - r.mean()  # for the precision of differences of squares
    values = torch.stack([torch.ones_like(p), p, r, p.square(), r.square(), p * r], dim=1)
    sums = values.new_zeros(rows * columns, 6).index_add_(0, tiles, values)
    mean_p, mean_r, square_p, square_r, product = (sums[:, 1:] / sums[:, :1].clamp_min(1)).unbind(dim=1)
    variance_p = (square_p - mean_p.square()).clamp_min(0) + FLAT**2
    variance_r = (square_r - mean_r.square()).clamp_min(0) + FLAT**2
    correlation = (product - mean_p * mean_r + FLAT**2) / (variance_p * variance_r).sqrt()
    return correlation[tiles]
