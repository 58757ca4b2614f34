"""The layers of the fusion network over many rows, one row per Gaussian."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from wildgs import features
from wildgs.model.fused_layers import fused_layers
from wildgs.rasterize.cpu.simd import has_avx512

PARTS = 128
LEAST_ROWS = 64 * PARTS
"""Smallest number of rows for `SplitLinear`."""
CHUNK = 4096
"""Rows per chunk of `ChunkedLayers`: a chunk's activations stay in a core's cache."""


def layers_over_rows(
    rows: Float[Tensor, "N I"], *weights: Tensor | None, precision: torch.dtype
) -> Float[Tensor, "N O"]:
    """The layers on the CPU by the faster implementation; weights as those of `ChunkedLayers`."""
    if has_avx512():
        return fused_layers(rows, [(None, (*weights, None))])[0]
    return ChunkedLayers.apply(rows, *weights, precision)


def linear_over_rows(
    rows: Float[Tensor, "N I"], weight: Float[Tensor, "O I"], bias: Float[Tensor, " O"]
) -> Float[Tensor, "N O"]:
    """``rows @ weight.T + bias``, one row per Gaussian, in the precision of the rows or of autocast."""
    if rows.is_cuda and len(rows) >= LEAST_ROWS and features.is_on("split_weights"):
        return SplitLinear.apply(rows, weight, bias)
    return functional.linear(rows, weight, bias)


class SplitLinear(torch.autograd.Function):
    """`torch.nn.functional.linear` whose weight gradient is summed in `PARTS` parts, in the dtype of the rows.

    Gradients of weight and bias have the dtype of these.
    The gradient of a small weight matrix (64 x 48) is a reduction over all Gaussians. As one product it has a
    single output tile, which occupies few of a GPU's multiprocessors.
    """

    @staticmethod
    def forward(ctx: Any, rows: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        """Computes [N, O] from rows [N, I], weight [O, I] and bias [O]."""
        ctx.dtype, weight = weight.dtype, weight.to(rows.dtype)
        ctx.save_for_backward(rows, weight)
        return functional.linear(rows, weight, bias.to(rows.dtype))

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
        by_weight = torch.bmm(parts[0].transpose(1, 2), parts[1]).sum(0, dtype=ctx.dtype)
        if whole < len(rows):
            by_weight = by_weight + gradient[whole:].T @ rows[whole:]
        return by_rows, by_weight, gradient.sum(0, dtype=ctx.dtype)


class ChunkedLayers(torch.autograd.Function):
    """``relu(relu(x W1ᵀ + b1) W2ᵀ + b2) W3ᵀ + b3 + x Dᵀ`` in chunks of rows, for the CPU.

    Layer by layer, the activations of all Gaussians (several MB each) pass through memory a dozen times. A chunk's
    stay in the cache from the first layer to the last. The skip connection D is computed in float32, because it
    carries the base colours; all other products have the given precision.
    """

    @staticmethod
    def forward(
        ctx: Any,
        rows: Float[Tensor, "N I"],
        first: Float[Tensor, "H I"],
        first_bias: Float[Tensor, " H"],
        second: Float[Tensor, "H H"],
        second_bias: Float[Tensor, " H"],
        last: Float[Tensor, "O H"],
        last_bias: Float[Tensor, " O"],
        direct: Float[Tensor, "O I"] | None,
        precision: torch.dtype,
    ) -> Float[Tensor, "N O"]:
        """Computes the layers; see the class."""
        weights = [each.to(precision) for each in (first, second, last)]
        biases = [each.to(precision) for each in (first_bias, second_bias, last_bias)]
        hidden = [rows.new_empty(len(rows), len(each), dtype=precision) for each in weights[:2]]
        output = rows.new_empty(len(rows), len(last))
        for part in _chunks(len(rows)):
            x = rows[part].to(precision)
            one, two = hidden[0][part], hidden[1][part]
            torch.addmm(biases[0], x, weights[0].T, out=one).relu_()
            torch.addmm(biases[1], one, weights[1].T, out=two).relu_()
            output[part] = torch.addmm(biases[2], two, weights[2].T)
            if direct is not None:
                output[part].addmm_(rows[part], direct.T)
        ctx.save_for_backward(rows, *hidden, *weights, direct)
        return output

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        """Gradients of rows, weights and biases."""
        rows, one, two, first, second, last, direct = ctx.saved_tensors
        (gradient,) = gradients
        by_rows = torch.empty_like(rows)
        by_weight = [rows.new_zeros(each.shape) for each in (first, second, last)]
        by_bias = [rows.new_zeros(len(each)) for each in (first, second, last)]
        by_direct = None if direct is None else rows.new_zeros(direct.shape)
        for part in _chunks(len(rows)):
            x = rows[part].to(first.dtype)
            of_three = gradient[part].to(first.dtype)
            of_two = torch.ops.aten.threshold_backward(of_three @ last, two[part], 0)
            of_one = torch.ops.aten.threshold_backward(of_two @ second, one[part], 0)
            layers = ((of_one, x), (of_two, one[part]), (of_three, two[part]))
            for place, (delta, before) in enumerate(layers):
                by_weight[place] += delta.T @ before
                by_bias[place] += delta.sum(0)
            by_rows[part] = of_one @ first
            if direct is not None and by_direct is not None:
                by_rows[part].addmm_(gradient[part], direct)
                by_direct.addmm_(gradient[part].T, rows[part])
        weights = [each for pair in zip(by_weight, by_bias, strict=True) for each in pair]
        return by_rows, *weights, by_direct, None


def _chunks(count: int) -> list[slice]:
    """Slices of at most `CHUNK` rows."""
    return [slice(start, min(start + CHUNK, count)) for start in range(0, count, CHUNK)]
