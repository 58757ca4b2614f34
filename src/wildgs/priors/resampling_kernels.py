"""The CPU kernel that displaces photos: bicubic sampling, in half the time that torch takes, channel by channel."""

from __future__ import annotations

import numpy as np

from wildgs.kernel_cache import njit
from wildgs.rasterize.cpu.simd import fma, splat
from wildgs.rasterize.cpu.simd_memory import vload, vstore
from wildgs.threads import fetch_add

ROWS = 8
"""Rows of pixels that a thread takes at once, so that results do not depend on the number of threads."""
SHARPNESS = np.float32(-0.75)
"""Parameter of the bicubic kernel, that of torch (Keys, "Cubic convolution interpolation", 1981)."""

_MATHS = {"reassoc", "contract", "arcp", "nsz"}  # without nnan, so that NaN propagates


@njit(nogil=True, fastmath=_MATHS, error_model="numpy")
def _sample_places(places, limit, pixels, weights):
    """The pixel below each place, and the bicubic kernel's weights of that one's neighbours -1, 0, 1 and 2.

    Beyond a border everything is as the border, so that places far beyond it are taken for nearer ones.
    """
    a, one, two, three = SHARPNESS, np.float32(1), np.float32(2), np.float32(3)
    w0, w1, w2, w3 = weights[0], weights[1], weights[2], weights[3]
    for j in range(places.shape[0]):
        place = min(max(places[j], -three), np.float32(limit + 2))
        below = np.floor(place)
        f, g = place - below, below + one - place
        pixels[j] = np.int32(below)
        w0[j] = a * f * g * g
        w1[j] = ((a + two) * f - (a + three)) * f * f + one
        w2[j] = ((a + two) * g - (a + three)) * g * g + one
        w3[j] = a * g * f * f


@njit(nogil=True, fastmath=_MATHS, error_model="numpy")
def _sample_near_border(photo, left, top, across, down, j, result):
    """`result` = the photo at one place, whose neighbours are the border's pixels where they are beyond it."""
    height, width = photo.shape[0], photo.shape[1]
    result[:] = np.float32(0)
    for k in range(4):
        row = photo[min(max(top - 1 + k, 0), height - 1)]
        for m in range(4):
            pixel, weight = row[min(max(left - 1 + m, 0), width - 1)], down[k, j] * across[m, j]
            for c in range(3):
                result[c] += weight * pixel[c]


@njit(nogil=True, fastmath=_MATHS, error_model="numpy")
def warp_rows(counter, photo, shifts, cells, weights, out):
    """Rows of out[p] = photo[p + shift(p)], by bicubic interpolation, clamped to [0, 1].

    Neighbours of a place in a row of the photo are twelve numbers, which one vector takes.

    Args:
        counter: Number of blocks of rows that threads have taken.
        photo: [H, W, 3].
        shifts: Shifts (x, y) in pixels, interpolated to the rows: [H, 2, G].
        cells: For each column, the lower of the two cells between which shifts are interpolated: [W].
        weights: Weight of the upper one: [W].
        out: [H, W, 3].
    """
    height, width = photo.shape[0], photo.shape[1]
    upper = 1 if shifts.shape[2] > 1 else 0
    x, y = np.empty(width, np.float32), np.empty(width, np.float32)
    lefts, tops = np.empty(width, np.int32), np.empty(width, np.int32)
    across, down = np.empty((4, width), np.float32), np.empty((4, width), np.float32)
    columns, color = np.empty(16, np.float32), np.empty(3, np.float32)
    zero, one = np.float32(0), np.float32(1)
    while True:
        first = fetch_add(counter, 1) * ROWS
        if first >= height:
            break
        for i in range(first, min(first + ROWS, height)):
            x_shifts, y_shifts = shifts[i, 0], shifts[i, 1]
            for j in range(width):
                low, high, weight = cells[j], cells[j] + upper, weights[j]
                x[j] = np.float32(j) + x_shifts[low] + weight * (x_shifts[high] - x_shifts[low])
                y[j] = np.float32(i) + y_shifts[low] + weight * (y_shifts[high] - y_shifts[low])
            _sample_places(x, width, lefts, across)
            _sample_places(y, height, tops, down)
            for j in range(width):
                left, top = lefts[j] - 1, tops[j] - 1
                place = (top * width + left) * 3
                if (
                    left < 0
                    or top < 0
                    or top + 4 > height
                    or left + 4 > width
                    or place + 9 * width + 16 > photo.size
                ):
                    _sample_near_border(photo, left + 1, top + 1, across, down, j, color)
                    for c in range(3):
                        out[i, j, c] = min(max(color[c], zero), one)
                    continue
                sums = down[0, j] * vload(photo, place)
                sums = fma(splat(down[1, j]), vload(photo, place + 3 * width), sums)
                sums = fma(splat(down[2, j]), vload(photo, place + 6 * width), sums)
                sums = fma(splat(down[3, j]), vload(photo, place + 9 * width), sums)
                vstore(columns, 0, sums)
                a, b, c, d = across[0, j], across[1, j], across[2, j], across[3, j]
                red = a * columns[0] + b * columns[3] + c * columns[6] + d * columns[9]
                green = a * columns[1] + b * columns[4] + c * columns[7] + d * columns[10]
                blue = a * columns[2] + b * columns[5] + c * columns[8] + d * columns[11]
                out[i, j, 0] = min(max(red, zero), one)
                out[i, j, 1] = min(max(green, zero), one)
                out[i, j, 2] = min(max(blue, zero), one)
