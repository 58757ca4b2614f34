"""Gaussians that continue the ground where no photo tells of it: thin discs, opaque from the start."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

WIDTH, THICKNESS = 0.6, 0.1
"""Standard deviations along and across the ground, in units of the spacing: neighbours overlap."""
OPACITY = 0.7


def ground_rows(points: Float[Tensor, "G 3"], spacing: float) -> dict[str, Tensor]:
    """Geometry of the ground's Gaussians.

    Args:
        points: Their centres in the aligned frame, +z up (`wildgs.priors.ground`).
        spacing: Distance between neighbours.

    Returns:
        Rows as `wildgs.model.gaussians.geometry_from_points` gives them.
    """
    count = len(points)
    scales = spacing * torch.tensor([WIDTH, WIDTH, THICKNESS])
    return {
        "means": points.float().clone(),
        "quats": torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        "log_scales": scales.log().repeat(count, 1),
        "opacity_logits": torch.full((count,), OPACITY).logit(),
    }
