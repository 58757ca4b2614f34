"""What speaks for something standing in the way, pixel by pixel: the gradient of the visibility mask.

Two things must come together: a colour that the scene does not have there, and a structure that it does not have.
Another light changes colours, by day and by dusk also their hue; it leaves edges and patterns where they are.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

COLOR_CELLS = 60
"""Colours are compared in so many cells along the long side: paving and bricks that the scene has not learnt yet,
or that are a pixel off, average out; people do not."""
BRIGHTNESS_SHARE = 0.25
"""Of a difference in brightness against one in colour, squared: light and shadow change the one, people also the
other."""
HALF_EVIDENCE = 0.11
"""Difference of colours at which evidence reaches half of its limit."""
MOST_EVIDENCE = 0.8
"""Limit of the evidence, in units of the image loss: twice λ^M's start, so that what is surely in the way is hidden
at once."""
STRUCTURE_SIDE = 240
"""Structure is compared at about this many pixels along the long side, or at the photo's size if it is smaller."""
STRUCTURE_WINDOWS = 24
"""Windows along the long side in which structure is compared."""
SAME_STRUCTURE = 0.7
"""Correlation from which on photo and render show the same thing, whatever their colours."""
FLAT = 0.005
"""Standard deviation of grey values below which a window counts as flat, about that of the rounding to 8 bits."""

PROOF_CELLS = 60
"""A triangulated point that the photo observes speaks for the cell in which it lies, of so many along the long
side."""
PROOF = 0.4
"""Weight of the proof that a cell is static, in units of the image loss: λ^M's start."""


@torch.no_grad()
def transient_evidence(photo: Float[Tensor, "H W 3"], render: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W"]:
    """How much a pixel looks as if something stood in the way, from 0 to `MOST_EVIDENCE`.

    The product of `color_evidence` and of the doubt that photo and render show the same structure, which falls
    linearly from 1 for a structural correlation of 0 or less to 0 for `SAME_STRUCTURE`.

    Args:
        photo: I, in 0..1.
        render: Î.
    """
    doubt = (1 - structural_correlation(photo, render) / SAME_STRUCTURE).clamp(0, 1)
    return color_evidence(photo, render) * doubt


@torch.no_grad()
def color_evidence(photo: Float[Tensor, "H W 3"], render: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W"]:
    """How much a pixel's colour speaks for something in the way, from 0 to `MOST_EVIDENCE`.

    The difference x of mean colours in cells, brightness counting less than hue, beyond the photo's median: while
    all of a photo is still wrong, nothing is transient, and the mask cannot settle on hiding everything. Then
    ``x⁴ / (x⁴ + s⁴)``: what is clearly wrong is wrong alike, what is a little off is not, and one edge does not
    outweigh a person.

    Args:
        photo: I, in 0..1.
        render: Î.

    Returns:
        Interpolated from cells to pixels.
    """
    height, width = photo.shape[:2]
    side = max(1, round(max(height, width) / COLOR_CELLS))
    difference = (photo - render.clamp(0, 1)).permute(2, 0, 1)[None]
    cells = functional.avg_pool2d(difference, side, ceil_mode=True, count_include_pad=False)
    brightness = cells.mean(dim=1, keepdim=True)
    hue = (cells - brightness).square().sum(dim=1, keepdim=True)
    distance = (2 * (hue + BRIGHTNESS_SHARE * brightness.square())).sqrt()
    fourth = (distance - distance.median()).clamp_min(0) ** 4
    evidence = MOST_EVIDENCE * fourth / (fourth + HALF_EVIDENCE**4)
    return functional.interpolate(evidence, size=(height, width), mode="bilinear")[0, 0]


@torch.no_grad()
def structural_correlation(
    photo: Float[Tensor, "H W 3"], render: Float[Tensor, "H W 3"]
) -> Float[Tensor, "H W"]:
    """Correlation of grey values in a window around every pixel, from -1 to 1.

    Where both windows vary it is their normalised cross-correlation, which a light that varies slowly leaves at 1.
    Both are taken to share noise of the standard deviation `FLAT`: two flat windows are alike (1), a flat one and
    one with structure are not (about 0).

    Args:
        photo: I, in 0..1.
        render: Î.
    """
    height, width = photo.shape[:2]
    grey = torch.stack([photo.mean(dim=2), render.clamp(0, 1).mean(dim=2)])[:, None]
    shrink = max(1, round(max(height, width) / STRUCTURE_SIDE))
    if shrink > 1:
        grey = functional.avg_pool2d(grey, shrink, ceil_mode=True, count_include_pad=False)
    grey = grey - grey.mean(dim=(2, 3), keepdim=True)  # for the precision of differences of squares
    radius = max(1, round(max(grey.shape[2:]) / STRUCTURE_WINDOWS / 2))
    moments = _box_mean(torch.cat([grey, grey.square(), grey[:1] * grey[1:]]), radius)
    mean_p, mean_r, square_p, square_r, product = moments[:, 0]
    variance_p = (square_p - mean_p.square()).clamp_min(0) + FLAT**2
    variance_r = (square_r - mean_r.square()).clamp_min(0) + FLAT**2
    covariance = product - mean_p * mean_r + FLAT**2
    correlation = covariance / (variance_p * variance_r).sqrt()
    return functional.interpolate(correlation[None, None], size=(height, width), mode="bilinear")[0, 0]


def _box_mean(x: Float[Tensor, "B 1 H W"], radius: int) -> Float[Tensor, "B 1 H W"]:
    """Means over squares of ``2 radius + 1`` pixels around every pixel, cut off at the borders."""
    return _line_mean(_line_mean(x, radius).mT, radius).mT


def _line_mean(x: Float[Tensor, "*batch W"], radius: int) -> Float[Tensor, "*batch W"]:
    """Means over ``2 radius + 1`` entries of a row around every one, from sums up to each."""
    width = x.shape[-1]
    sums = functional.pad(x.cumsum(dim=-1), (1, 0))
    place = torch.arange(width, device=x.device)
    low, high = (place - radius).clamp_min(0), (place + radius + 1).clamp_max(width)
    return (sums[..., high] - sums[..., low]) / (high - low)


@torch.no_grad()
def proven_static(observations: Float[Tensor, "K 2"], height: int, width: int) -> Bool[Tensor, "H W"]:
    """Pixels in cells in which the photo observes a triangulated point: other photos show the same thing there.

    Args:
        observations: Pixels (x, y) of the points.
        height: Of the photo.
        width: Of the photo.
    """
    side = max(1, round(max(height, width) / PROOF_CELLS))
    rows, columns = -(-height // side), -(-width // side)
    cells = torch.zeros(rows, columns, dtype=torch.bool, device=observations.device)
    x, y = (observations / side).long().unbind(1)
    cells[y.clamp(0, rows - 1), x.clamp(0, columns - 1)] = True
    return cells.repeat_interleave(side, 0).repeat_interleave(side, 1)[:height, :width]
