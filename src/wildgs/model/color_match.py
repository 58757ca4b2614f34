"""Matching a scene's colours to a photo: what the embedding missed of its exposure and colour cast.

Not in the paper. A network that has seen some ninety photos guesses a new photo's light, and the photo itself says
how far off the guess is. NeRF-W's line of work optimises the embedding of a new photo for that; an affine map of
colours is found in closed form, from one render, and brings most of what many steps of optimisation bring.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

ROUNDS = 6
RIDGE = 3e-4
"""Of the least squares, in units of mean squared colour: what a photo does not tell stays as it was."""
OUTLIER = 0.05
"""Residual at which a pixel counts half (Cauchy's weights): passers-by that the mask has missed."""
LEAST_PIXELS = 64
"""Fewer say nothing about a photo's light."""


@torch.no_grad()
def match_colors(
    render: Float[Tensor, "H W 3"], photo: Float[Tensor, "H W 3"], weights: Float[Tensor, "H W"]
) -> Float[Tensor, "3 4"]:
    """The affine map of colours that takes a render to its photo, by robust least squares.

    Args:
        render: In 0..1, more where the scene is brighter than white.
        photo: In 0..1.
        weights: Of the pixels, 0 or more; 0 where something stands in the way.

    Returns:
        Change [A | b]: colours c become ``c + A c + b``. Zero where too little of the scene is seen.
    """
    nothing = torch.zeros(3, 4, device=render.device)
    chosen = weights > 0
    if int(chosen.sum()) < LEAST_PIXELS:
        return nothing
    colors = render[chosen].clamp(0, 1).double()
    residual = photo[chosen].double() - colors
    padded = torch.cat([colors, torch.ones_like(colors[:, :1])], dim=1)
    base = weights[chosen].double()
    ridge = RIDGE * torch.eye(4, dtype=padded.dtype, device=padded.device)
    change = torch.zeros(4, 3, dtype=padded.dtype, device=padded.device)
    trusted = base
    for _ in range(ROUNDS):
        weighted = padded * (trusted / trusted.sum())[:, None]
        change = torch.linalg.solve(weighted.T @ padded + ridge, weighted.T @ residual)
        error = (residual - padded @ change).abs().mean(dim=1)
        trusted = base * OUTLIER**2 / (OUTLIER**2 + error.square())
    return change.T.float().contiguous() if change.isfinite().all() else nothing
