"""The mask loss, which keeps the mask from hiding everything."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor


def visibility_regularizer(visibility: Float[Tensor, "H W"]) -> Float[Tensor, ""]:
    """``mean((1 - M)^2)``, the paper's L^M.

    Args:
        visibility: M, 1 where the photo shows the static scene.

    Returns:
        0 where all is visible, 1 where all is hidden.
    """
    return (1 - visibility).square().mean()
