"""A linear layer over a million rows whose weight gradient is summed in parts.

The gradient of a weight of 64 x 48 numbers is one product that reduces over all Gaussians: a single tile of the
result, which few of a GPU's multiprocessors can work on. In parts, all of them do.
"""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from wildgs import features

PARTS = 128
LEAST_ROWS = 64 * PARTS
"""Fewer rows are one product."""


def linear_over_rows(
    rows: Float[Tensor, "N I"], weight: Float[Tensor, "O I"], bias: Float[Tensor, " O"]
) -> Float[Tensor, "N O"]:
    """``rows @ weight.T + bias`` in the precision of the rows, or of autocast.

    Args:
        rows: One a Gaussian.
        weight: Of the layer.
        bias: Of the layer.
    """
    if rows.is_cuda and len(rows) >= LEAST_ROWS and features.is_on("split_weights"):
        return SplitLinear.apply(rows, weight.to(rows.dtype), bias.to(rows.dtype))
    return functional.linear(rows, weight, bias)


class SplitLinear(torch.autograd.Function):
    """`torch.nn.functional.linear` of operands of one dtype, with a gradient in `PARTS` parts."""

    @staticmethod
    def forward(ctx: Any, rows: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        """Rows [N, I], weight [O, I] and bias [O] to [N, O]."""
        ctx.save_for_backward(rows, weight)
        return functional.linear(rows, weight, bias)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, Tensor, Tensor]:
        """Gradients of rows, weight and bias."""
        rows, weight = ctx.saved_tensors
        gradient = gradients[0].to(rows.dtype)
        by_rows = gradient @ weight if ctx.needs_input_grad[0] else None
        whole = len(rows) // PARTS * PARTS
        parts = (
            gradient[:whole].view(PARTS, -1, weight.shape[0]),
            rows[:whole].view(PARTS, -1, weight.shape[1]),
        )
        sums = torch.bmm(parts[0].transpose(1, 2), parts[1]).sum(0, dtype=torch.float32)
        by_weight = sums + (gradient[whole:].T @ rows[whole:]).float()
        return by_rows, by_weight.to(weight.dtype), gradient.sum(0)
