"""The layers of the fusion network by kernels of their own, for processors with AVX-512."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from wildgs.model import fusion_kernels
from wildgs.rasterize.cpu.simd import LANES
from wildgs.threads import flat, launch

WEIGHTS = 8
"""Weights of a region: W1, b1, W2, b2, W3, b3, D and C."""
Region = tuple[Int[Tensor, " _"] | None, Sequence[Tensor | None]]
"""Indices of rows, None for all of them, and the weights of their layers."""

_NONE = np.empty(0, np.float32)
_ALL = np.empty(0, np.int64)


def fused_layers(
    rows: Float[Tensor, "N I"], regions: Sequence[Region]
) -> tuple[Float[Tensor, "V O"], Float[Tensor, "A C"]]:
    """The layers of `wildgs.model.fusion_layers.ChunkedLayers` for regions with weights of their own, in float32.

    The products of a fusion network are narrow (48 columns). Libraries take as long to arrange their operands as to
    compute them, and are slowest at gradients of weights, which are sums over all Gaussians. Rows are read where
    they are, and their gradients written where they belong, because gathering and scattering them takes as long as
    a tenth of a training step. Results do not depend on the number of threads.

    Args:
        rows: Inputs of all Gaussians.
        regions: Rows of each region and its weights: those of `ChunkedLayers`, and C [C, I] or None. All regions
            have the same sizes, and no row is in two of them.

    Returns:
        Outputs of the regions, one after the other, and ``x Cᵀ`` of those with C.
    """
    return FusedLayers.apply(rows, [index for index, _ in regions], *(w for _, each in regions for w in each))


class FusedLayers(torch.autograd.Function):
    """See `fused_layers`."""

    @staticmethod
    def forward(
        ctx: Any, rows: Float[Tensor, "N I"], indices: Sequence[Tensor | None], *weights: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Computes outputs and codes."""
        ctx.regions = [
            _RegionLayers(rows, index, weights[place * WEIGHTS : (place + 1) * WEIGHTS])
            for place, index in enumerate(indices)
        ]
        coded = [part for part in ctx.regions if part.codes]
        out = rows.new_empty(sum(part.count for part in ctx.regions), ctx.regions[0].outputs)
        out_codes = rows.new_empty(sum(part.count for part in coded), coded[0].codes if coded else 0)
        values, code_values = flat(out), flat(out_codes)
        for part in ctx.regions:
            values, code_values = part.forward(flat(rows), values, code_values)
        ctx.whole = any(index is None for index in indices)
        ctx.save_for_backward(rows)
        return out, out_codes

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        """Gradients of rows and weights."""
        (rows,) = ctx.saved_tensors
        by_rows = torch.empty_like(rows) if ctx.whole else torch.zeros_like(rows)
        values, code_values = (flat(gradient) for gradient in gradients)
        found: list[Tensor | None] = []
        for part in ctx.regions:
            by_weights, values, code_values = part.backward(flat(rows), values, code_values, flat(by_rows))
            found += by_weights
        return by_rows, None, *found


class _RegionLayers:
    """The weights of one region as kernels take them, and its rows.

    Attributes:
        index: Indices of the rows; empty for all.
        count: Number of rows.
        outputs: Width of the output.
        codes: Number of codes, 0 without C.
    """

    def __init__(
        self, rows: Float[Tensor, "N I"], index: Int[Tensor, " V"] | None, weights: Sequence[Tensor | None]
    ) -> None:
        self._weights = weights
        first, first_bias, second, second_bias, last, last_bias = (w for w in weights[:6] if w is not None)
        direct, codes = weights[6:]
        self.index = _ALL if index is None else flat(index)
        self.count = len(rows) if index is None else len(index)
        self.outputs, self.codes = len(last), 0 if codes is None else len(codes)
        self.padded = inputs, hidden, outputs, code_width = tuple(
            -(-size // LANES) * LANES for size in (rows.shape[1], len(first), self.outputs, self.codes)
        )
        self._sizes = (rows.shape[1], inputs, hidden, self.outputs, outputs, self.codes, code_width)
        self._hidden_layers = (
            _padded(first.T, hidden), _padded(first_bias[None], hidden),
            _padded(second.T, hidden, hidden), _padded(second_bias[None], hidden),
        )  # fmt: skip
        self._outer_layers = (
            _padded(last.T, outputs, hidden), _padded(last_bias[None], outputs),
            _NONE if direct is None else _padded(direct.T, outputs),
            _NONE if codes is None else _padded(codes.T, code_width),
        )  # fmt: skip
        self._back = (
            _padded(first, inputs, hidden), _padded(second, hidden, hidden), _padded(last, hidden),
            _NONE if direct is None else _padded(direct, inputs),
            _NONE if codes is None else _padded(codes, inputs),
        )  # fmt: skip
        self._zeros = np.zeros(max(self.padded), np.float32)

    @property
    def _items(self) -> int:
        return -(-self.count // fusion_kernels.PART)

    def forward(self, rows: np.ndarray, out: np.ndarray, codes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Writes outputs and codes to the beginnings of `out` and `codes`; returns what follows them."""
        launch(
            fusion_kernels.layers_forward, self.count, rows, self.index, *self._sizes, *self._hidden_layers,
            *self._outer_layers, self._zeros, out, codes,
            items=self._items,
        )  # fmt: skip
        return out[self.count * self.outputs :], codes[self.count * self.codes :]

    def backward(
        self, rows: np.ndarray, gradient: np.ndarray, code_gradient: np.ndarray, by_rows: np.ndarray
    ) -> tuple[list[Tensor | None], np.ndarray, np.ndarray]:
        """Writes gradients of the rows; returns those of the weights, and the gradients of the next regions."""
        inputs, hidden, outputs, code_width = self.padded
        shapes = (
            (hidden, inputs), (1, hidden), (hidden, hidden), (1, hidden), (outputs, hidden), (1, outputs),
            (outputs, inputs), (code_width, inputs),
        )  # fmt: skip
        sizes = [height * width for height, width in shapes]
        sums = np.empty((self._items, sum(sizes)), np.float32)
        launch(
            fusion_kernels.layers_backward, self.count, rows, self.index, gradient, code_gradient, *self._sizes,
            *self._hidden_layers, *self._back, self._zeros, by_rows, sums,
            items=self._items,
        )  # fmt: skip
        parts = torch.from_numpy(sums.sum(0)).split(sizes)
        found = [
            None if weight is None else _cut(part.view(shape), weight)
            for part, shape, weight in zip(parts, shapes, self._weights, strict=True)
        ]
        return found, gradient[self.count * self.outputs :], code_gradient[self.count * self.codes :]


def _padded(matrix: Float[Tensor, "R C"], columns: int, rows: int = 0) -> Float[np.ndarray, " _"]:
    """A matrix with zeros added on the right and below, as kernels take it."""
    out = matrix.new_zeros(max(rows, len(matrix)), columns)
    out[: len(matrix), : matrix.shape[1]] = matrix.detach()
    return flat(out)


def _cut(padded: Float[Tensor, "R C"], like: Tensor) -> Tensor:
    """Undoes `_padded`, for a matrix or a bias."""
    if like.ndim == 1:
        return padded[0, : len(like)]
    return padded[: len(like), : like.shape[1]]
