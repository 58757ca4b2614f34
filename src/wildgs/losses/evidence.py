"""Evidence that pixels show transient objects, which replaces the gradient of the visibility mask.

Evidence requires a difference in colour and a difference in structure from the render. Different lighting changes
brightness and hue but not edges and patterns.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

COLOR_CELLS = 60
"""Cells along the longer side in which mean colours are compared. Fine texture that is not learnt yet or is off by
a pixel averages out, people do not."""
BRIGHTNESS_SHARE = 0.25
"""Weight of a squared difference in brightness relative to one in chroma, since light and shadow change
brightness."""
HALF_EVIDENCE = 0.11
"""Colour difference at which the evidence is half of its maximum."""
MOST_EVIDENCE = 0.8
"""Maximum of the evidence, in units of the image loss: twice the initial λ^M, so that certain transients are hidden
at once."""
FOREGROUND_EVIDENCE = 0.4
"""Evidence of what a depth prior shows in free space, in the same units; such priors are wrong at times."""
NIGHT, DUSK = 0.15, 0.3
"""Median brightness of a photo below which it was taken at night, and from which on it was not."""
LIT = 0.1
"""How much brighter than its render a surface is that a lamp surely lights."""
STRUCTURE_SIDE = 240
"""Approximate longer side, in pixels, to which larger photos are reduced for comparing structure."""
STRUCTURE_WINDOWS = 24
"""Number of windows along the longer side in which structure is compared."""
SAME_STRUCTURE = 0.7
"""Correlation from which photo and render are taken to show the same object, whatever their colours."""
FLAT = 0.005
"""Standard deviation of grey values of a flat window, about that of rounding to 8 bits."""

PROOF_CELLS = 60
"""Cells along the longer side. A cell in which the photo observes a triangulated point is taken to be static."""
PROOF = 0.4
"""Weight of the evidence that such a cell is static, in units of the image loss: the initial λ^M."""


@torch.no_grad()
def transient_evidence(photo: Float[Tensor, "H W 3"], render: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W"]:
    """Evidence that a pixel is transient, from 0 to `MOST_EVIDENCE`.

    The product of `color_evidence` and structural dissimilarity, which decreases linearly from 1 at a structural
    correlation of 0 or less to 0 at `SAME_STRUCTURE`.

    Args:
        photo: I, RGB in [0, 1].
        render: Î.
    """
    doubt = (1 - structural_correlation(photo, render) / SAME_STRUCTURE).clamp(0, 1)
    return color_evidence(photo, render) * doubt


@torch.no_grad()
def color_evidence(photo: Float[Tensor, "H W 3"], render: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W"]:
    """Evidence from a pixel's colour that it is transient, from 0 to `MOST_EVIDENCE`.

    Let x be the difference of mean colours in cells, with a lower weight on brightness, minus its median over the
    photo. The median prevents the mask from hiding everything while the whole render is still poor. The evidence is
    proportional to ``x⁴ / (x⁴ + s⁴)``, a soft threshold that ignores small differences and saturates for large
    ones. In photos taken at night, what is brighter than its render is lit by lamps and no evidence: a floodlit
    wall that is hidden is never learnt, and where it is overexposed there is no structure to compare.

    Args:
        photo: I, RGB in [0, 1].
        render: Î.

    Returns:
        The evidence, interpolated from cells to pixels.
    """
    height, width = photo.shape[:2]
    side = max(1, round(max(height, width) / COLOR_CELLS))
    difference = (photo - render.clamp(0, 1)).permute(2, 0, 1)[None]
    cells = functional.avg_pool2d(difference, side, ceil_mode=True, count_include_pad=False)
    brightness = cells.mean(dim=1, keepdim=True)
    hue = (cells - brightness).square().sum(dim=1, keepdim=True)
    distance = (2 * (hue + BRIGHTNESS_SHARE * brightness.square())).sqrt()
    fourth = (distance - distance.median()).clamp_min(0) ** 4
    lit = (brightness / LIT).clamp(0, 1) * _night(photo[::side, ::side])
    evidence = MOST_EVIDENCE * fourth / (fourth + HALF_EVIDENCE**4) * (1 - lit)
    return functional.interpolate(evidence, size=(height, width), mode="bilinear")[0, 0]


def _night(photo: Float[Tensor, "H W 3"]) -> Float[Tensor, ""]:
    """Degree to which a photo was taken at night, from 0 to 1."""
    return ((DUSK - photo.mean(dim=2).median()) / (DUSK - NIGHT)).clamp(0, 1)


@torch.no_grad()
def structural_correlation(
    photo: Float[Tensor, "H W 3"], render: Float[Tensor, "H W 3"]
) -> Float[Tensor, "H W"]:
    """Correlation of grey values in a window around every pixel, from -1 to 1.

    This is the normalised cross-correlation, which is invariant to smooth changes of lighting. Both windows are
    assumed to share noise of standard deviation `FLAT`, so that two flat windows have correlation 1, and a flat and
    a structured one about 0.

    Args:
        photo: I, RGB in [0, 1].
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
    """Means over squares of ``2 radius + 1`` pixels around every pixel, cropped at the borders."""
    return _column_mean(_column_mean(x, radius).mT.contiguous(), radius).mT


def _column_mean(x: Float[Tensor, "*batch H W"], radius: int) -> Float[Tensor, "*batch H W"]:
    """Means over ``2 radius + 1`` entries of a column around every entry, by cumulative sums.

    Sums down the columns are vectorised over the rows' contiguous entries on the CPU; sums along rows are not.
    """
    height = x.shape[-2]
    sums = functional.pad(x.cumsum(dim=-2), (0, 0, 1, 0))
    place = torch.arange(height, device=x.device)
    low, high = (place - radius).clamp_min(0), (place + radius + 1).clamp_max(height)
    return (sums.index_select(-2, high) - sums.index_select(-2, low)) / (high - low)[:, None]


@torch.no_grad()
def proven_static(observations: Float[Tensor, "K 2"], height: int, width: int) -> Bool[Tensor, "H W"]:
    """Pixels in cells in which the photo observes a triangulated point, and which are therefore static.

    Args:
        observations: Pixels (x, y) of the points.
        height: Height of the photo.
        width: Width of the photo.
    """
    side = max(1, round(max(height, width) / PROOF_CELLS))
    rows, columns = -(-height // side), -(-width // side)
    cells = torch.zeros(rows * columns, dtype=torch.bool, device=observations.device)
    x, y = (observations / side).long().unbind(1)
    # Unlike an assignment to indices, this does not upload the value, for which a GPU would be waited for.
    cells.index_fill_(0, columns * y.clamp(0, rows - 1) + x.clamp(0, columns - 1), value=True)
    cells = cells.reshape(rows, columns)
    return cells.repeat_interleave(side, 0).repeat_interleave(side, 1)[:height, :width]
