"""Numba (njit) functions that tell what a Gaussian reaches: pixels where its alpha is at least 1/255, an ellipse.

The ellipse is tested against rectangles of pixel centres, exactly but for a slack that covers rounding.
"""

from __future__ import annotations

import numpy as np

from wildgs.kernel_cache import njit
from wildgs.rasterize.cpu.simd import fma, lane_x, lane_y, mask_bits, vmax, vmin
from wildgs.rasterize.interface import TILE

# Floats per Gaussian: x, y, a, b, d, level, y_per_x, x_per_y, with log2 alpha = level - u^2 - v^2, u = a dx + b dy
# and v = d dy (the Cholesky factor of the conic): fewer operations than dx^2, dx dy and dy^2, and a needle's
# exponent is no difference of large numbers. y_per_x = -a b / (b^2 + d^2) and x_per_y = -b / a.
RECORD = 8
MIN_LEVEL = np.float32(-7.99435344)  # log2(1/255)
REACH = np.float32(-7.99435344 - 0.01)
HALF = np.float32(0.5)


@njit(nogil=True)
def least_falloff(x0, y0, x1, y1, a, b, d, y_per_x, x_per_y):
    """Smallest value of (a x + b y)^2 + (d y)^2 in the rectangle from (x0, y0) to (x1, y1).

    It lies on the edge that faces the centre, horizontal or vertical. Along a column the value is smallest at
    y = x * y_per_x, along a row at x = y * x_per_y.
    """
    edge_x = vmin(vmax(x0, 0.0), x1)
    edge_y = vmin(vmax(y0, 0.0), y1)
    best_y = vmin(vmax(edge_x * y_per_x, y0), y1)
    best_x = vmin(vmax(edge_y * x_per_y, x0), x1)
    u, v = fma(a, edge_x, b * best_y), d * best_y
    vertical = fma(u, u, v * v)
    u, v = fma(a, best_x, b * edge_y), d * edge_y
    return vmin(vertical, fma(u, u, v * v))


@njit(nogil=True)
def reach(x, y, side, a, b, d, level, y_per_x, x_per_y):
    """Which squares of a 4 x 4 arrangement a Gaussian reaches, as 16 bits.

    (x, y) is the centre of the arrangement's first pixel minus the Gaussian's, `side` the length of a square, in
    pixels; the other arguments are fields of a record, see `RECORD`.
    """
    x0 = lane_x() * side + x
    y0 = lane_y() * side + y
    more = side - np.float32(1.0)
    least = least_falloff(x0, y0, x0 + more, y0 + more, a, b, d, y_per_x, x_per_y)
    return mask_bits(least <= level - REACH)


@njit(nogil=True)
def window_mask(i, records, tx, ty):
    """Bits of the 4 x 4 tiles from tile (tx, ty) that the Gaussian of record i reaches."""
    r = i * RECORD
    return reach(
        np.float32(tx * TILE) + HALF - records[r],
        np.float32(ty * TILE) + HALF - records[r + 1],
        np.float32(TILE),
        records[r + 2], records[r + 3], records[r + 4], records[r + 5], records[r + 6], records[r + 7],
    )  # fmt: skip


@njit(nogil=True)
def inside_bits(tx, ty, last_x, last_y):
    """Bits of a 4 x 4 window of tiles at (tx, ty) that lie no further than tile (last_x, last_y)."""
    columns = (1 << min(last_x - tx + 1, 4)) - 1
    rows = min(last_y - ty + 1, 4)
    return (columns * 0x1111) & ((1 << (4 * rows)) - 1)


@njit(nogil=True)
def count_bits(bits):
    """How many bits are set."""
    count = 0
    while bits != 0:
        bits &= bits - 1
        count += 1
    return count
