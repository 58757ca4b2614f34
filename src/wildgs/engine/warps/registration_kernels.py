"""CPU kernels that register photos with renders.

Torch needs twice as long: it writes ten products of images that are only needed as sums over cells. Threads take
rows of pixels or of cells, so that results do not depend on their number.
"""

from __future__ import annotations

import numpy as np

from wildgs.kernel_cache import njit
from wildgs.threads import fetch_add

ROWS = 8
"""Rows of pixels that a thread takes at once."""
PRODUCTS = 10
"""Number of products that `sum_products` sums."""

_MATHS = {"reassoc", "contract", "arcp", "nsz"}  # without nnan, so that NaN propagates


@njit(nogil=True, fastmath=_MATHS, error_model="numpy")
def grey_rows(counter, picture, luma, grey):
    """Brightness of a picture [H, W, 3], to `grey` [H, W]."""
    height, width = grey.shape
    red, green, blue = luma[0], luma[1], luma[2]
    while True:
        first = fetch_add(counter, 1) * ROWS
        if first >= height:
            break
        for i in range(first, min(first + ROWS, height)):
            row, source = grey[i], picture[i]
            for j in range(width):
                row[j] = red * source[j, 0] + green * source[j, 1] + blue * source[j, 2]


@njit(nogil=True, fastmath=_MATHS, error_model="numpy")
def sum_rows(counter, maps, shares, sums):
    """sums[k, r] = sum of maps[k, i] over rows i, times the share shares[r, i] that cell r has in row i."""
    count, cells = sums.shape[0], sums.shape[1]
    height, width = maps.shape[1], maps.shape[2]
    while True:
        item = fetch_add(counter, 1)
        if item >= cells:
            break
        for k in range(count):
            row = sums[k, item]
            row[:] = np.float32(0)
            for i in range(item * height // cells, min((item + 1) * height // cells + 1, height)):
                share, source = shares[item, i], maps[k, i]
                for j in range(width):
                    row[j] += share * source[j]


@njit(nogil=True, fastmath=_MATHS, error_model="numpy")
def subtract_interpolated(counter, maps, lines, cells, weights):
    """Subtracts from rows maps[k, i] what is interpolated linearly along lines[k, i], of a value per cell."""
    count, height, width = maps.shape
    upper = 1 if lines.shape[2] > 1 else 0
    while True:
        first = fetch_add(counter, 1) * ROWS
        if first >= height:
            break
        for k in range(count):
            for i in range(first, min(first + ROWS, height)):
                row, line = maps[k, i], lines[k, i]
                for j in range(width):
                    low = line[cells[j]]
                    row[j] -= low + weights[j] * (line[cells[j] + upper] - low)


@njit(nogil=True, fastmath=_MATHS, error_model="numpy")
def sum_products(counter, seen, shown, shares, sums):
    """Sums of products over rows of pixels, as `sum_rows`: what registration needs (`displacement`).

    Args:
        counter: Number of rows of cells that threads have taken.
        seen: Fine detail of the photo, [H, W].
        shown: That of its render.
        shares: Share of each row of cells in each row of pixels, [G, H].
        sums: Of seen², shown², seen * shown; x², xy, y² of the gradient (x, y) of `seen`; x * shown, y * shown,
            x * seen, y * seen: [10, G, W].
    """
    cells = sums.shape[1]
    height, width = seen.shape
    across, down = np.zeros(width, np.float32), np.zeros(width, np.float32)
    half = np.float32(0.5)
    while True:
        item = fetch_add(counter, 1)
        if item >= cells:
            break
        sums[:, item] = np.float32(0)
        a, b, c, d, e = sums[0, item], sums[1, item], sums[2, item], sums[3, item], sums[4, item]
        f, g, h, k, m = sums[5, item], sums[6, item], sums[7, item], sums[8, item], sums[9, item]
        for i in range(item * height // cells, min((item + 1) * height // cells + 1, height)):
            share, one, two = shares[item, i], seen[i], shown[i]
            left, right, inside = one[: width - 2], one[2:], across[1 : width - 1]
            for j in range(width - 2):
                inside[j] = half * (right[j] - left[j])
            if 0 < i < height - 1:
                above, below = seen[i - 1], seen[i + 1]
                for j in range(width):
                    down[j] = half * (below[j] - above[j])
            else:
                down[:] = np.float32(0)
            for j in range(width):
                u, v, x, y = one[j], two[j], across[j], down[j]
                su, sx, sy = share * u, share * x, share * y
                a[j] += su * u
                b[j] += share * v * v
                c[j] += su * v
                d[j] += sx * x
                e[j] += sx * y
                f[j] += sy * y
                g[j] += sx * v
                h[j] += sy * v
                k[j] += sx * u
                m[j] += sy * u
