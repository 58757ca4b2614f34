"""The image loss: masked L1 and structural dissimilarity."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from wildgs.losses.ssim import ssim, ssim_map

EVIDENCE_SCALE = 2
"""The mask's evidence is gathered at half resolution: cheaper, and deaf to detail that is a pixel off."""


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
    scene's edges instead of passers-by. Here hiding a pixel is worth what the pixel's `mismatch` exceeds the
    photo's median by: while all of a photo is still wrong, nothing is transient, and the mask cannot settle on
    hiding everything.

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
        cost = mismatch(photo, render.detach(), weight_l1)
        excess = (cost - cost.median()).clamp_min(0)
        # Adds nothing to the value, and the excess to the mask's gradient.
        loss = loss + ((visibility - fixed) * excess).mean()
    return loss


@torch.no_grad()
def mismatch(
    photo: Float[Tensor, "H W 3"], render: Float[Tensor, "H W 3"], weight_l1: float = 0.8
) -> Float[Tensor, "H W"]:
    """What a pixel costs in the image loss when nothing is masked: ``λ |I - Î| + (1 - λ) (1 - SSIM)``.

    Args:
        photo: I, in 0..1.
        render: Î.
        weight_l1: λ.

    Returns:
        The mean over channels, at half resolution and interpolated up.
    """
    pair = torch.stack([photo, render]).permute(0, 3, 1, 2)
    small = functional.avg_pool2d(pair, EVIDENCE_SCALE, ceil_mode=True, count_include_pad=False)
    x, y = small.permute(0, 2, 3, 1)
    cost = (weight_l1 * (x - y).abs() + (1 - weight_l1) * (1 - ssim_map(x, y))).mean(dim=-1)
    return functional.interpolate(cost[None, None], size=photo.shape[:2], mode="bilinear")[0, 0]


def _photometric(photo: Tensor, render: Tensor, weight_l1: float) -> Tensor:
    return weight_l1 * (photo - render).abs().mean() + (1 - weight_l1) * (1 - ssim(photo, render))
