"""The image loss: masked L1 and structural dissimilarity."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from wildgs.losses.ssim import ssim

EVIDENCE_CELLS = 60
"""The mask's evidence is gathered in so many cells along the long side: paving and bricks that the scene has not
learnt yet, or that are a pixel off, average out; people do not."""
BRIGHTNESS_SHARE = 0.25
"""Of a difference in brightness against one in colour, squared: light and shadow change the one, people also the
other."""
HALF_EVIDENCE = 0.15
"""Difference of colours at which evidence reaches half of its limit."""
MOST_EVIDENCE = 0.8
"""Its limit, in units of the image loss: twice λ^M's start, so that what is surely in the way is hidden at once."""


def masked_photometric(
    photo: Float[Tensor, "H W 3"],
    render: Float[Tensor, "H W 3"],
    visibility: Float[Tensor, "H W"] | None,
    weight_l1: float = 0.8,
) -> Float[Tensor, ""]:
    """``λ |I⊙M - Î⊙M| + (1 - λ) (1 - SSIM(I⊙M, Î⊙M))``, paper section 'Transient Objects Handling'.

    The paper prints ``+SSIM`` where it means the dissimilarity; ``1 - SSIM`` (not halved) is 3DGS's, and the
    mean runs over all pixels, hidden ones included, as the paper's formula does.

    The value is the formula's, and so is the gradient to the render. The gradient to the mask is not: through
    SSIM of two pictures that share a factor M, a mask lowers the loss by being textured itself, and learns the
    scene's edges instead of passers-by. Here hiding a pixel is worth its `transient_evidence`.

    Args:
        photo: The reference photo I, in 0..1.
        render: The rendered picture Î.
        visibility: M, 1 where the photo shows the static scene; None stands for 1 everywhere.
        weight_l1: λ.

    Returns:
        The loss.
    """
    if visibility is None:
        return _photometric(photo, render, weight_l1)
    fixed = visibility.detach()
    loss = _photometric(photo * fixed[..., None], render * fixed[..., None], weight_l1)
    if visibility.requires_grad:
        # Adds nothing to the value, and the evidence to the mask's gradient.
        loss = loss + ((visibility - fixed) * transient_evidence(photo, render.detach())).mean()
    return loss


@torch.no_grad()
def transient_evidence(photo: Float[Tensor, "H W 3"], render: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W"]:
    """How much a pixel looks as if something stood in the way, from 0 to `MOST_EVIDENCE`.

    The difference x of mean colours in cells, brightness counting less than hue, beyond the photo's median: while
    all of a photo is still wrong, nothing is transient, and the mask cannot settle on hiding everything. Then
    ``x⁴ / (x⁴ + s⁴)``: what is clearly wrong is wrong alike, what is a little off is not, and one edge does not
    outweigh a person.

    Args:
        photo: I, in 0..1.
        render: Î.

    Returns:
        Interpolated up from cells to pixels.
    """
    height, width = photo.shape[:2]
    side = max(1, round(max(height, width) / EVIDENCE_CELLS))
    difference = (photo - render.clamp(0, 1)).permute(2, 0, 1)[None]
    cells = functional.avg_pool2d(difference, side, ceil_mode=True, count_include_pad=False)
    brightness = cells.mean(dim=1, keepdim=True)
    hue = (cells - brightness).square().sum(dim=1, keepdim=True)
    distance = (2 * (hue + BRIGHTNESS_SHARE * brightness.square())).sqrt()
    fourth = (distance - distance.median()).clamp_min(0) ** 4
    evidence = MOST_EVIDENCE * fourth / (fourth + HALF_EVIDENCE**4)
    return functional.interpolate(evidence, size=(height, width), mode="bilinear")[0, 0]


def _photometric(photo: Tensor, render: Tensor, weight_l1: float) -> Tensor:
    return weight_l1 * (photo - render).abs().mean() + (1 - weight_l1) * (1 - ssim(photo, render))
