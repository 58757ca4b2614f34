"""Back-projection of a photo's static pixels to a coloured point cloud (paper, Triplane Color Creation)."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from wildgs.geometry.camera import Camera

MIN_ALPHA = 0.5
"""Rendered depth means something only where the Gaussians cover a pixel."""


def liftable(
    visibility: Float[Tensor, "H W"] | None, alpha: Float[Tensor, "H W"], threshold: float
) -> Bool[Tensor, "H W"]:
    """Pixels that may be lifted: static (M > Th) and covered by Gaussians."""
    covered = alpha > MIN_ALPHA
    return covered if visibility is None else covered & (visibility > threshold)


def random_part(height: int, width: int, device: torch.device | str = "cpu") -> Bool[Tensor, "H W"]:
    """What lies on one side of a straight cut, upright or level, through the middle half of a picture."""
    place, upright, kept_first = torch.rand(3).tolist()
    length = width if upright < 0.5 else height
    first = torch.arange(length, device=device) < round((0.25 + 0.5 * place) * length)
    chosen = first if kept_first < 0.5 else ~first
    return (chosen[None, :] if upright < 0.5 else chosen[:, None]).expand(height, width)


@torch.no_grad()
def lift(
    photo: Float[Tensor, "H W 3"], depth: Float[Tensor, "H W"], camera: Camera
) -> tuple[Float[Tensor, "P 3"], Float[Tensor, "P 3"]]:
    """BP: all pixels as world points P and their colours C, row by row.

    Args:
        photo: RGB in [0, 1].
        depth: Expected depth along the camera's z axis, world units.
        camera: The photo's camera.
    """
    return camera.unproject(depth).reshape(-1, 3), photo.reshape(-1, 3)
