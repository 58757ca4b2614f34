"""The image loss: masked L1 and structural dissimilarity."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from wildgs.losses.evidence import FOREGROUND_EVIDENCE, PROOF, transient_evidence
from wildgs.losses.ssim import ssim


def masked_photometric(
    photo: Float[Tensor, "H W 3"],
    render: Float[Tensor, "H W 3"],
    visibility: Float[Tensor, "H W"] | None,
    weight_l1: float = 0.8,
    *,
    power: float = 1.0,
    proven: Bool[Tensor, "H W"] | None = None,
    doubt: Float[Tensor, "_ _"] | None = None,
    foreground: Float[Tensor, "_ _"] | None = None,
) -> Float[Tensor, ""]:
    """``λ |I⊙M - Î⊙M| + (1 - λ) (1 - SSIM(I⊙M, Î⊙M))``, paper section 'Transient Objects Handling'.

    The paper prints ``+SSIM``, but means the dissimilarity ``1 - SSIM`` (not halved), as in 3DGS. The mean is over
    all pixels including hidden ones, as in the paper.

    Value and gradient to the render are those of the formula. The gradient to the mask is not: since both images
    are multiplied by M before SSIM, a textured mask lowers the loss, so that it would learn the scene's edges
    instead of passers-by. Instead, the gradient is `transient_evidence`, or `-PROOF` for pixels known to be static.

    Args:
        photo: The photo I, RGB in [0, 1].
        render: The render Î.
        visibility: M, 1 where the photo shows the static scene; None = 1 everywhere.
        weight_l1: λ.
        power: Exponent of M in the formula (paper: 1).
        proven: Pixels known to be static (`proven_static`); None for none.
        doubt: Degree to which pixels may be transient, 0 to 1, a factor on the evidence, in cells that cover the
            photo (`wildgs.priors.consensus.doubts`); None for 1 everywhere.
        foreground: Degree to which pixels are transient whatever their colour, 0 to 1, in cells that cover the
            photo (`wildgs.priors.free_space`); None for 0 everywhere.

    Returns:
        The loss.
    """
    if visibility is None:
        return _photometric(photo, render, weight_l1)
    fixed = visibility.detach()
    weight = (fixed if power == 1 else fixed**power)[..., None]
    loss = _photometric(photo * weight, render * weight, weight_l1)
    if visibility.requires_grad:
        # Adds zero to the value and the evidence to the mask's gradient.
        evidence = transient_evidence(photo, render.detach())
        if doubt is not None:
            evidence = evidence * _enlarged(doubt, evidence)
        if foreground is not None:
            evidence = torch.maximum(evidence, FOREGROUND_EVIDENCE * _enlarged(foreground, evidence))
        if proven is not None:
            evidence = torch.where(proven, -PROOF, evidence)
        loss = loss + ((visibility - fixed) * evidence).mean()
    return loss


def _enlarged(cells: Tensor, pixels: Tensor) -> Tensor:
    return functional.interpolate(cells[None, None], size=pixels.shape, mode="bilinear")[0, 0]


def _photometric(photo: Tensor, render: Tensor, weight_l1: float) -> Tensor:
    return weight_l1 * (photo - render).abs().mean() + (1 - weight_l1) * (1 - ssim(photo, render))
