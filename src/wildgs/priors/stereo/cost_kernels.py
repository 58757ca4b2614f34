"""Numba (njit) kernels of PatchMatch stereo: the matching cost of slanted planes by NCC windows.

A plane is the inverse depth of a pixel and its derivatives along x and y (q, q_x, q_y): the inverse depth of a
plane is affine in pixel coordinates. With M = K' R K^-1 and v = K' t, the point at pixel x projects to M x + v q(x)
in another camera, so a window is warped without computing a homography per plane.

The images of all photos are stored in flat arrays: `pixels`, and `blocks` of four pixels (see `pack_blocks`); a row
of `layout` is (offset, width, height). The loops over a window have no branch, so that LLVM vectorises them.

`compared` is a tuple: pixels, blocks, layout, the photo's row, rows of its neighbours, their motions (12 numbers: M
in row-major order, then v), coarser planes of all photos (or none) and their layout, and the number of best
neighbours that are averaged.
"""

from __future__ import annotations

import numpy as np

from wildgs.kernel_cache import njit

SAMPLES = 32
"""Pixels of a window: every second row and column of 11 x 11, without the corners."""
RADIUS = 5
WORST = np.float32(2.0)
BLANK = np.float32(4e-5)
"""Windows of lower variance (of brightness in [0, 1]) are textureless: a standard deviation of 1.6 of 255."""
_MATHS = {"reassoc", "contract", "arcp", "nsz", "afn"}
_RANGE_SIGMA, _SPACE_SIGMA = np.float32(0.08), np.float32(6.0)
_DISAGREEMENT, _TRUNCATED = np.float32(0.3), np.float32(0.04)
"""Cost of inconsistent planes of two photos, and the relative depth difference at which it is reached."""
_SCALE = np.float32(65535.0)
_LOW, _16, _32, _48 = np.uint64(0xFFFF), np.uint64(16), np.uint64(32), np.uint64(48)


def window_offsets() -> np.ndarray:
    """Offsets (x, y) of a window's pixels from its centre, [2, SAMPLES]."""
    steps = np.arange(-RADIUS, RADIUS + 1, 2)
    x, y = np.meshgrid(steps, steps)
    inner = np.abs(x) + np.abs(y) < 2 * RADIUS
    return np.stack([x[inner], y[inner]]).astype(np.float32)


def pack_blocks(picture: np.ndarray) -> np.ndarray:
    """Packs each pixel with its right, lower and lower right neighbours into 64 bits, 16 bits each.

    Bilinear interpolation then needs one gather instead of four; gathers dominate the running time.
    """
    values = np.pad(np.round(picture.clip(0, 1) * 65535).astype(np.uint64), ((0, 1), (0, 1)), mode="edge")
    packed = values[:-1, :-1] | (values[:-1, 1:] << _16) | (values[1:, :-1] << _32) | (values[1:, 1:] << _48)
    return packed.reshape(-1)


@njit(nogil=True, fastmath=_MATHS, error_model="numpy")
def read_window(pixels, place, x, y, window):
    """Writes a window's zero-mean brightness times bilateral weights to `values`; returns its weighted variance."""
    offset, width, height = place
    offsets, values, weights = window
    centre = pixels[np.uint64(offset + y * width + x)]
    total = np.float32(0.0)
    mean = np.float32(0.0)
    for k in range(SAMPLES):
        i = min(max(x + np.int64(offsets[0, k]), 0), width - 1)
        j = min(max(y + np.int64(offsets[1, k]), 0), height - 1)
        value = pixels[np.uint64(offset + j * width + i)]
        distance = (offsets[0, k] ** 2 + offsets[1, k] ** 2) / (2 * _SPACE_SIGMA * _SPACE_SIGMA)
        weight = np.exp(-abs(value - centre) / _RANGE_SIGMA - distance)
        values[k] = value
        weights[k] = weight
        total += weight
        mean += weight * value
    mean /= total
    variance = np.float32(0.0)
    for k in range(SAMPLES):
        weights[k] /= total
        values[k] -= mean
        variance += weights[k] * values[k] * values[k]
    for k in range(SAMPLES):
        values[k] *= weights[k]
    return variance


@njit(nogil=True, fastmath=_MATHS, error_model="numpy")
def _correlation_cost(
    blocks,
    offset,
    width,
    height,
    motions,
    s,
    coarse,
    start,
    across,
    down,
    x,
    y,
    q,
    qx,
    qy,
    offsets,
    values,
    weights,
    variance,
):
    """1 - NCC of a window and its warp by a plane into another photo; `WORST` outside that photo.

    The other photo starts at `offset` of `blocks`; its motion is row `s` of `motions`. If its `coarse` planes are
    given (`across` x `down` of them from `start`), a penalty for the difference from them is added. Arrays are
    passed separately: unpacking a tuple or slicing here counts references, which costs as much as the comparison.
    """
    cx, cy = np.float32(x) + np.float32(0.5), np.float32(y) + np.float32(0.5)
    x0 = motions[s, 0] * cx + motions[s, 1] * cy + motions[s, 2] + motions[s, 9] * q
    y0 = motions[s, 3] * cx + motions[s, 4] * cy + motions[s, 5] + motions[s, 10] * q
    z0 = motions[s, 6] * cx + motions[s, 7] * cy + motions[s, 8] + motions[s, 11] * q
    if z0 <= np.float32(1e-6):
        return WORST
    u0, v0 = x0 / z0, y0 / z0
    if u0 < 1 or v0 < 1 or u0 > width - 1 or v0 > height - 1:
        return WORST
    xx, yx, zx = (
        motions[s, 0] + motions[s, 9] * qx,
        motions[s, 3] + motions[s, 10] * qx,
        motions[s, 6] + motions[s, 11] * qx,
    )
    xy, yy, zy = (
        motions[s, 1] + motions[s, 9] * qy,
        motions[s, 4] + motions[s, 10] * qy,
        motions[s, 7] + motions[s, 11] * qy,
    )
    right, bottom = np.float32(width) - np.float32(1.001), np.float32(height) - np.float32(1.001)
    total = np.float32(0.0)
    square = np.float32(0.0)
    product = np.float32(0.0)
    least = np.float32(1e-6)
    for k in range(SAMPLES):
        dx, dy = offsets[0, k], offsets[1, k]
        inverse = np.float32(1.0) / max(z0 + dx * zx + dy * zy, least)
        u = (x0 + dx * xx + dy * xy) * inverse - np.float32(0.5)
        v = (y0 + dx * yx + dy * yy) * inverse - np.float32(0.5)
        u = min(max(u, np.float32(0.0)), right)
        v = min(max(v, np.float32(0.0)), bottom)
        i, j = np.int32(u), np.int32(v)
        fu, fv = u - np.float32(i), v - np.float32(j)
        four = blocks[np.uint64(offset + j * width + i)]
        a, b = np.float32(np.int32(four & _LOW)), np.float32(np.int32((four >> _16) & _LOW))
        c, d = np.float32(np.int32((four >> _32) & _LOW)), np.float32(np.int32(four >> _48))
        top, low = a + fu * (b - a), c + fu * (d - c)
        value = top + fv * (low - top)
        total += weights[k] * value
        square += weights[k] * value * value
        product += values[k] * value
    penalty = np.float32(0.0)
    if coarse.size > 0:
        column = u0 * (np.float32(across) / np.float32(width))
        line = v0 * (np.float32(down) / np.float32(height))
        left, above = min(np.int64(column), across - 1), min(np.int64(line), down - 1)
        at = start + above * across + left
        right_of, below = (
            column - np.float32(left) - np.float32(0.5),
            line - np.float32(above) - np.float32(0.5),
        )
        there = coarse[at, 0] + coarse[at, 1] * right_of + coarse[at, 2] * below
        penalty = _DISAGREEMENT * min(np.float32(1.0), abs(there * z0 - q) / (_TRUNCATED * q))
    other = square - total * total
    if other < BLANK * _SCALE * _SCALE:
        return np.float32(1.0) + penalty
    return np.float32(1.0) - product / np.sqrt(other * variance) + penalty


@njit(nogil=True, fastmath=_MATHS, error_model="numpy")
def plane_cost(compared, x, y, q, qx, qy, window, variance, costs):
    """Mean cost of a plane over its `best` matching neighbours; in the others it may be occluded."""
    blocks, layout, neighbours, motions = compared[1], compared[2], compared[4], compared[5]
    coarse, coarse_layout, best = compared[6], compared[7], compared[8]
    offsets, values, weights = window
    for s in range(neighbours.size):
        n = neighbours[s]
        cost = _correlation_cost(
            blocks,
            layout[n, 0],
            layout[n, 1],
            layout[n, 2],
            motions,
            s,
            coarse,
            coarse_layout[n, 0],
            coarse_layout[n, 1],
            coarse_layout[n, 2],
            x,
            y,
            q,
            qx,
            qy,
            offsets,
            values,
            weights,
            variance,
        )
        at = s
        while at > 0 and costs[at - 1] > cost:
            costs[at] = costs[at - 1]
            at -= 1
        costs[at] = cost
    total = np.float32(0.0)
    for s in range(best):
        total += min(costs[s], np.float32(1.0) + _DISAGREEMENT)
    return total / np.float32(best)
