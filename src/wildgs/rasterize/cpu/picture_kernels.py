"""Numba (njit) functions between pictures (row by row) and a tile's blocks of 4 x 4 pixels (one vector each)."""

from __future__ import annotations

import numpy as np

from wildgs.kernel_cache import njit
from wildgs.rasterize.cpu.reach_kernels import TILE
from wildgs.rasterize.cpu.simd import lane_x, select, splat, vmin
from wildgs.rasterize.cpu.simd_memory import (
    copy4,
    copy8,
    prefetch,
    prefetch_to_write,
    vload,
    vload3,
    vstore,
    vstore3,
)

LANES = 16
PATCH = 48  # floats that a block of three channels has
COLORS = 4  # the first channel's place among a block's vectors, after transmittance, column, alpha and depth
CLOSED = np.float32(1e15)  # column of a pixel that takes nothing more; its square is finite


@njit(nogil=True)
def aligned(size):
    """A float32 array that starts at a cache line, so that no vector straddles two."""
    raw = np.empty(size + 16, np.float32)
    skip = (64 - raw.ctypes.data % 64) % 64 // 4
    return raw[skip : skip + size]


@njit(nogil=True)
def put_rows(patch, per_pixel, picture, x, y, width, height):
    """Writes a block's pixels, row after row in `patch`, to the picture at (x, y), cut at its border."""
    row, count = 4 * per_pixel, min(4, width - x) * per_pixel
    for line in range(min(4, height - y)):
        at = ((y + line) * width + x) * per_pixel
        if count == row == 12:
            copy8(picture, at, patch, line * 12)
            copy4(picture, at + 8, patch, line * 12 + 8)
        elif count == row == 4:
            copy4(picture, at, patch, line * 4)
        else:
            for k in range(count):
                picture[at + k] = patch[line * row + k]


@njit(nogil=True)
def get_rows(patch, per_pixel, picture, x, y, width, height):
    """Reads a block's pixels from the picture; 0 beyond its border."""
    row, count = 4 * per_pixel, min(4, width - x) * per_pixel
    if count < row or height - y < 4:
        patch[:] = 0.0
    for line in range(min(4, height - y)):
        at = ((y + line) * width + x) * per_pixel
        if count == row == 12:
            copy8(patch, line * 12, picture, at)
            copy4(patch, line * 12 + 8, picture, at + 8)
        elif count == row == 4:
            copy4(patch, line * 4, picture, at)
        else:
            for k in range(count):
                patch[line * row + k] = picture[at + k]


@njit(nogil=True)
def ask_for_tile(tx, ty, width, height, per_pixel, picture, to_write):
    """Prefetches a tile's cache lines: its rows are far apart, which hardware prefetchers do not detect."""
    for line in range(min(TILE, height - ty * TILE)):
        at = ((ty * TILE + line) * width + tx * TILE) * per_pixel
        for step in range(0, TILE * per_pixel, LANES):
            if to_write:
                prefetch_to_write(picture, at + step)
            else:
                prefetch(picture, at + step)


@njit(nogil=True)
def open_tile(tx, ty, width, height, stride, sums):
    """Sums 0, transmittance 1, and columns (`CLOSED` outside the picture); returns the bits of blocks inside."""
    alive = 0
    sums[:] = 0.0
    for block in range(16):
        x, y = tx * TILE + (block & 3) * 4, ty * TILE + (block >> 2) * 4
        vstore(sums, block * stride, splat(1.0))
        vstore(sums, block * stride + LANES, splat(CLOSED))
        if x < width and y < height:
            alive |= 1 << block
            vstore(sums, block * stride + LANES, lane_x() + np.float32((block & 3) * 4))
            if x + 4 > width or y + 4 > height:
                for lane in range(LANES):
                    if x + (lane & 3) >= width or y + (lane >> 2) >= height:
                        sums[block * stride + LANES + lane] = CLOSED
    return alive


@njit(nogil=True)
def close_tile(
    tx, ty, width, height, channels, with_depth, background, stride, sums, patch, out_colors, out_depth, out_alpha
):  # fmt: skip
    """Writes a finished tile's colours, expected depth and alpha into the pictures."""
    for block in range(16):
        x, y, at = tx * TILE + (block & 3) * 4, ty * TILE + (block >> 2) * 4, block * stride
        if x >= width or y >= height:
            continue
        transmittance = vload(sums, at)
        # Summed, not 1 - transmittance: what is faint would have few digits left.
        alpha = vmin(vload(sums, at + 2 * LANES), 1.0)
        vstore(patch, 0, alpha)
        put_rows(patch, 1, out_alpha, x, y, width, height)
        if with_depth:
            seen = alpha > 0.0
            vstore(patch, 0, select(seen, vload(sums, at + 3 * LANES) / select(seen, alpha, 1.0), 0.0))
            put_rows(patch, 1, out_depth, x, y, width, height)
        if channels == 3:
            red = vload(sums, at + COLORS * LANES) + transmittance * background[0]
            green = vload(sums, at + (COLORS + 1) * LANES) + transmittance * background[1]
            blue = vload(sums, at + (COLORS + 2) * LANES) + transmittance * background[2]
            vstore3(patch, 0, (red, green, blue))
            put_rows(patch, 3, out_colors, x, y, width, height)
        else:
            for lane in range(LANES):
                if x + (lane & 3) < width and y + (lane >> 2) < height:
                    pixel = (y + (lane >> 2)) * width + x + (lane & 3)
                    through = sums[at + lane]
                    for k in range(channels):
                        value = sums[at + (k + COLORS) * LANES + lane] + through * background[k]
                        out_colors[pixel * channels + k] = value


@njit(nogil=True)
def load_block(
    x, y, width, height, channels, with_depth, background, out_depth, out_alpha, v_colors, v_depth, v_alpha,
    patch, v, to_alpha, to_depth, to_colors,
):  # fmt: skip
    """Reads a block's incoming gradients: of accumulated alpha, of the depth sum, and of the channels."""
    get_rows(patch, 1, v_alpha, x, y, width, height)
    total = vload(patch, 0)
    if channels == 3:
        get_rows(patch, 3, v_colors, x, y, width, height)
        red, green, blue = vload3(patch, 0)
        vstore(v, to_colors, red)
        vstore(v, to_colors + LANES, green)
        vstore(v, to_colors + 2 * LANES, blue)
        total = total - red * background[0] - green * background[1] - blue * background[2]
    else:
        for k in range(channels):
            for lane in range(LANES):
                inside = x + (lane & 3) < width and y + (lane >> 2) < height
                pixel = (y + (lane >> 2)) * width + x + (lane & 3)
                v[to_colors + k * LANES + lane] = (
                    v_colors[pixel * channels + k] if inside else np.float32(0.0)
                )
            total = total - vload(v, to_colors + k * LANES) * background[k]
    if with_depth:
        get_rows(patch, 1, out_alpha, x, y, width, height)
        alpha = vload(patch, 0)
        get_rows(patch, 1, v_depth, x, y, width, height)
        share = vload(patch, 0)
        share = select(alpha > 0.0, share / select(alpha > 0.0, alpha, 1.0), 0.0)
        get_rows(patch, 1, out_depth, x, y, width, height)
        vstore(v, to_depth, share)
        total = total - share * vload(patch, 0)
    vstore(v, to_alpha, total)
