"""Registration of a photo with its render: displacements on a grid, by Lucas and Kanade's method (1981)."""

from __future__ import annotations

from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from wildgs.devices import upload
from wildgs.engine.warps.registration_kernels import (
    PRODUCTS,
    ROWS,
    grey_rows,
    subtract_interpolated,
    sum_products,
    sum_rows,
)
from wildgs.priors.resampling import between, interpolated, interpolation, pooled, pooling
from wildgs.scene.images import LUMA
from wildgs.threads import launch

SIDE = 480
"""Longer side, in pixels, to which larger photos are reduced for registration."""
COARSE = 4
"""Cells of this many pixels, whose means are subtracted: light and shadow differ at coarser scales."""
DAMPING = 0.01
"""Added to squared gradients of images of unit contrast, so that nothing is displaced where there is no texture."""
FLAT = 1e-6
"""Added to the variance of a cell: about that of rounding to 8 bits."""
LONGEST = 1.0
"""Largest displacement found at once along an axis, in pixels of the reduced photo; the linear model ends there."""


def displacement(
    photo: Float[Tensor, "H W 3"], render: Float[Tensor, "H W 3"], cells: int
) -> Float[Tensor, "2 G G"]:
    """Where the photo shows what the render shows: one step of Lucas and Kanade's registration.

    Minimises, over a window of a few cells, the squared difference between the fine detail of the render and of the
    displaced photo, each divided by its contrast there. Cells count by the squared correlation of the two, so that
    passers-by, who are not in the render, do not move anything.

    Args:
        photo: RGB in [0, 1].
        render: The scene from the photo's camera.
        cells: Number of cells G along each side.

    Returns:
        Displacements (x, y) in units of the longer side.
    """
    seen, shown = fine_detail(photo, render)
    means = _smoothed(mean_products(seen, shown, cells))
    variance, both = means[0] + FLAT, ((means[0] + FLAT) * (means[1] + FLAT)).sqrt()
    likeness = (means[2] / both).clamp_min(0).square()
    gradients, errors = means[3:6] / variance, means[6:8] / both - means[8:10] / variance
    xx, xy, yy, x, y = _smoothed(likeness * torch.cat([gradients, errors])).unbind()
    xx, yy = xx + DAMPING, yy + DAMPING
    moves = torch.stack([yy * x - xy * y, xx * y - xy * x]) / (xx * yy - xy * xy)
    # A render that is not finite moves nothing.
    return moves.clamp(-LONGEST, LONGEST).nan_to_num() / max(seen.shape)


def fine_detail(*images: Float[Tensor, "H W 3"]) -> Float[Tensor, "K h w"]:
    """Brightness of images of at most `SIDE` pixels, without details coarser than `COARSE` pixels."""
    grey = _grey(images)
    scale = min(1.0, SIDE / max(grey.shape[1:]))
    height, width = (max(3, round(scale * side)) for side in grey.shape[1:])
    if (height, width) != grey.shape[1:]:
        grey = pooled(grey, height, width)
    cells = -(-height // COARSE), -(-width // COARSE)
    return _subtract_means(grey, *cells) if grey.device.type == "cpu" else without_means(grey, *cells)


def without_means(maps: Float[Tensor, "K H W"], rows: int, columns: int) -> Float[Tensor, "K H W"]:
    """Images less the means of their cells, which are interpolated bilinearly."""
    return maps - interpolated(pooled(maps, rows, columns), *maps.shape[1:])


def _subtract_means(maps: Float[Tensor, "K H W"], rows: int, columns: int) -> Float[Tensor, "K H W"]:
    """`without_means` on the CPU and in place."""
    height, width = maps.shape[1:]
    sums = maps.new_empty(len(maps), rows, width)
    shares = pooling(height, rows, maps.device)
    launch(sum_rows, maps.numpy(), shares.numpy(), sums.numpy(), items=rows)
    lines = interpolation(rows, height, maps.device) @ (sums @ pooling(width, columns, maps.device).T)
    arrays = (tensor.numpy() for tensor in (maps, lines, *between(columns, width)))
    launch(subtract_interpolated, *arrays, items=-(-height // ROWS))
    return maps


def mean_products(
    seen: Float[Tensor, "h w"], shown: Float[Tensor, "h w"], cells: int
) -> Float[Tensor, "10 G G"]:
    """Means over cells of what registration needs.

    Args:
        seen: Fine detail of the photo.
        shown: That of its render.
        cells: Number of cells G along each side.

    Returns:
        Of seen², shown², seen * shown; of x², xy, y², where (x, y) is the gradient of `seen`; of x * shown,
        y * shown, x * seen and y * seen.
    """
    if seen.device.type != "cpu":
        return pooled(products(seen, shown), cells, cells)
    sums = seen.new_empty(PRODUCTS, cells, seen.shape[1])
    shares = pooling(seen.shape[0], cells, seen.device)
    launch(sum_products, *(tensor.numpy() for tensor in (seen, shown, shares, sums)), items=cells)
    return sums @ pooling(seen.shape[1], cells, seen.device).T


def products(seen: Float[Tensor, "h w"], shown: Float[Tensor, "h w"]) -> Float[Tensor, "10 h w"]:
    """What `mean_products` has the means of, at every pixel."""
    x = functional.pad(seen[:, 2:] - seen[:, :-2], (1, 1)) / 2
    y = functional.pad(seen[2:] - seen[:-2], (0, 0, 1, 1)) / 2
    pairs = [(seen, seen), (shown, shown), (seen, shown), (x, x), (x, y), (y, y)]
    pairs += [(x, shown), (y, shown), (x, seen), (y, seen)]
    found = seen.new_empty(PRODUCTS, *seen.shape)
    for product, (first, second) in zip(found, pairs, strict=True):
        torch.mul(first, second, out=product)
    return found


def _grey(images: tuple[Float[Tensor, "H W 3"], ...]) -> Float[Tensor, "K H W"]:
    device = images[0].device
    if device.type != "cpu":
        return torch.stack([image @ _luma(device) for image in images])
    grey = torch.empty(len(images), *images[0].shape[:2])
    for image, row in zip(images, grey, strict=True):
        arrays = (tensor.numpy() for tensor in (image.contiguous(), _luma(device), row))
        launch(grey_rows, *arrays, items=-(-len(row) // ROWS))
    return grey


def _smoothed(maps: Float[Tensor, "K G G"]) -> Float[Tensor, "K G G"]:
    """Binomial mean over three cells along each axis."""
    padded = functional.pad(maps[None], (1, 1, 1, 1), mode="replicate")[0]
    rows = padded[:, :-2] + 2 * padded[:, 1:-1] + padded[:, 2:]
    return (rows[..., :-2] + 2 * rows[..., 1:-1] + rows[..., 2:]) / 16


@lru_cache
def _luma(device: torch.device) -> Float[Tensor, "3"]:
    return upload(torch.tensor(LUMA), device)
