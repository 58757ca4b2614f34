"""The image loss: masked L1 and structural dissimilarity."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from wildgs.losses.ssim import ssim


def masked_photometric(
    photo: Float[Tensor, "H W 3"],
    render: Float[Tensor, "H W 3"],
    visibility: Float[Tensor, "H W"] | None,
    weight_l1: float = 0.8,
) -> Float[Tensor, ""]:
    """``λ |I⊙M - Î⊙M| + (1 - λ) (1 - SSIM(I⊙M, Î⊙M))``, paper section 'Handling Transient Objects'.

    The paper prints ``+SSIM`` where it means the dissimilarity; ``1 - SSIM`` (not halved) is 3DGS's, and the
    mean runs over all pixels, hidden ones included, as the paper's formula does. The gradient reaches the
    mask through both masked pictures, so that hiding a pixel lowers the loss by what the pixel costs.

    Args:
        photo: The reference photo I, in 0..1.
        render: The rendered picture Î.
        visibility: M, 1 where the photo shows the static scene; None stands for 1 everywhere.
        weight_l1: λ.

    Returns:
        The loss.
    """
    if visibility is not None:
        photo, render = photo * visibility[..., None], render * visibility[..., None]
    l1 = (photo - render).abs().mean()
    return weight_l1 * l1 + (1 - weight_l1) * (1 - ssim(photo, render))
