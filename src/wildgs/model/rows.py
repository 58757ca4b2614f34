"""Some of the Gaussians' rows at a time: those that a camera sees."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from wildgs.model.appearance import Appearance
from wildgs.model.method import Method
from wildgs.rasterize import Projection, sh_to_colors

ROWS_STEP = 1024


def rows_to_shade(visible: Bool[Tensor, "N"]) -> Int[Tensor, " V"]:
    """Indices of the visible Gaussians; on the CPU also of a few others, for a number that comes up again.

    Libraries compile a matrix product for every new shape there.
    """
    rows = visible.nonzero()[:, 0]
    if visible.device.type != "cpu":
        return rows
    missing = min(-len(rows) % ROWS_STEP, len(visible) - len(rows))
    if missing == 0:
        return rows
    return torch.cat([rows, (~visible).nonzero()[:missing, 0]])


def take_rows(values: Float[Tensor, "N *rest"], rows: Int[Tensor, " V"]) -> Float[Tensor, "V *rest"]:
    """``values[rows]`` for indices of which none comes twice.

    Its gradient is then written, not added up: indexing would sort the indices on a GPU to add in a fixed order.
    """
    return _TakeRows.apply(values, rows)


def paint_visible(
    method: Method, projection: Projection, appearance: Appearance, sh_degree: int
) -> Float[Tensor, "N 3"]:
    """Colours of the Gaussians that a camera sees; zero for all others, which are not even shaded."""
    means = method.gaussians.means
    rows = rows_to_shade(projection.visible)
    sh = method.shade(appearance, rows)
    seen = sh_to_colors(take_rows(means, rows), sh, projection.camera, degree=sh_degree)
    return torch.zeros_like(means).index_copy(0, rows, seen)


class _TakeRows(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, rows: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx.save_for_backward(rows)
        ctx.count = len(values)
        return values.index_select(0, rows)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:  # pyright: ignore[reportIncompatibleMethodOverride]
        (rows,) = ctx.saved_tensors
        return gradient.new_zeros(ctx.count, *gradient.shape[1:]).index_copy_(0, rows, gradient), None
