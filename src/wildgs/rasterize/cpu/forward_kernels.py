"""Numba (njit) kernels that blend tiles front to back.

A tile of 16 x 16 pixels is sixteen blocks of 4 x 4; a block is one vector. For each Gaussian of the tile's list
only the blocks that it reaches and that still let light through are visited.

A block's transmittance doubles as its pixels' state: negative where the pixel is saturated (its value is the
magnitude) or outside the picture.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from wildgs.rasterize.cpu.simd import (
    fetch_add,
    fma,
    lane_x,
    lane_y,
    lowest_bit,
    mask_bits,
    select,
    splat,
    vexp2,
    vload,
    vmax,
    vmin,
    vstore,
)
from wildgs.rasterize.cpu.tile_kernels import reach

TILE = 16
PIXELS = TILE * TILE
RECORD = 8
MIN_LEVEL = np.float32(-7.99435344)  # log2(1/255)
MAX_ALPHA = np.float32(0.999)
MIN_TRANSMITTANCE = np.float32(1e-4)
HALF = np.float32(0.5)


@njit(nogil=True, cache=True)
def open_tile(tx, ty, width, height, state):
    """Transmittance 1 inside the picture and -1 outside; returns the bits of blocks that have pixels inside."""
    alive = 0
    for block in range(16):
        for lane in range(16):
            x = tx * TILE + (block & 3) * 4 + (lane & 3)
            y = ty * TILE + (block >> 2) * 4 + (lane >> 2)
            inside = x < width and y < height
            state[block * 16 + lane] = 1.0 if inside else -1.0
            if inside:
                alive |= 1 << block
    return alive


@njit(nogil=True, cache=True)
def blend_forward(
    counter, tile_order, offsets, ids, records, depths, colors, channels, with_depth, background,
    width, height, out_colors, out_depth, out_alpha, final_transmittance, last,
):  # fmt: skip
    """Blends all tiles.

    `final_transmittance` and `last` (the last blended position in the tile's list, from 1) are laid out by tile
    and block for the backward pass; they are None where there will be none.
    """
    tiles_x = (width + TILE - 1) // TILE
    state = np.empty(PIXELS, np.float32)
    reached = np.empty(PIXELS, np.float32)
    sums = np.empty((channels + 1) * PIXELS, np.float32)
    while True:
        item = fetch_add(counter, 1)
        if item >= tile_order.size:
            break
        tile = tile_order[item]
        tx, ty = tile % tiles_x, tile // tiles_x
        alive = open_tile(tx, ty, width, height, state)
        sums[:] = 0.0
        reached[:] = 0.0
        begin = offsets[tile]
        for p in range(begin, offsets[tile + 1]):
            if alive == 0:
                break
            g = ids[p]
            r = g * RECORD
            x = np.float32(tx * TILE) + HALF - records[r]
            y = np.float32(ty * TILE) + HALF - records[r + 1]
            A, B, C, level = records[r + 2], records[r + 3], records[r + 4], records[r + 5]
            blocks = alive & reach(x, y, np.float32(4.0), A, B, C, level, records[r + 6], records[r + 7])
            while blocks != 0:
                block = lowest_bit(blocks)
                blocks &= blocks - 1
                at = block * 16
                dx = lane_x() + (x + np.float32((block & 3) * 4))
                dy = lane_y() + (y + np.float32((block >> 2) * 4))
                exponent = fma(dx, fma(dx, A, dy * B), fma(dy * C, dy, level))
                before = vload(state, at)
                hit = (exponent >= MIN_LEVEL) & (before > 0.0)
                alpha = vmin(vexp2(vmin(vmax(exponent, MIN_LEVEL), 0.0)), MAX_ALPHA)
                after = before - before * alpha
                kept = hit & (after > MIN_TRANSMITTANCE)
                weight = select(kept, before * alpha, 0.0)
                after = select(hit, select(kept, after, -before), before)
                vstore(state, at, after)
                if last is not None:
                    vstore(reached, at, select(kept, np.float32(p - begin + 1), vload(reached, at)))
                if channels == 3:
                    c = 3 * g
                    vstore(sums, at, fma(weight, colors[c], vload(sums, at)))
                    vstore(sums, at + PIXELS, fma(weight, colors[c + 1], vload(sums, at + PIXELS)))
                    vstore(sums, at + 2 * PIXELS, fma(weight, colors[c + 2], vload(sums, at + 2 * PIXELS)))
                else:
                    for k in range(channels):
                        vstore(
                            sums,
                            at + k * PIXELS,
                            fma(weight, colors[channels * g + k], vload(sums, at + k * PIXELS)),
                        )
                if with_depth:
                    d = at + channels * PIXELS
                    vstore(sums, d, fma(weight, depths[g], vload(sums, d)))
                if mask_bits(after > 0.0) == 0:
                    alive &= ~(1 << block)
        close_tile(
            tx,
            ty,
            width,
            height,
            channels,
            with_depth,
            background,
            state,
            sums,
            out_colors,
            out_depth,
            out_alpha,
        )
        if last is not None:
            for at in range(0, PIXELS, 16):
                transmittance = vload(state, at)
                vstore(final_transmittance, tile * PIXELS + at, vmax(transmittance, -transmittance))
                vstore(last, tile * PIXELS + at, vload(reached, at))


@njit(nogil=True, cache=True)
def close_tile(
    tx, ty, width, height, channels, with_depth, background, state, sums, out_colors, out_depth, out_alpha
):
    """Writes a finished tile into the pictures, row by row."""
    for row in range(min(TILE, height - ty * TILE)):
        for column in range(min(TILE, width - tx * TILE)):
            at = ((row >> 2) * 4 + (column >> 2)) * 16 + (row & 3) * 4 + (column & 3)
            pixel = (ty * TILE + row) * width + tx * TILE + column
            transmittance = abs(state[at])
            for k in range(channels):
                out_colors[pixel * channels + k] = sums[k * PIXELS + at] + transmittance * background[k]
            alpha = np.float32(1.0) - transmittance
            out_alpha[pixel] = alpha
            if with_depth:
                out_depth[pixel] = sums[channels * PIXELS + at] / alpha if alpha > 0.0 else np.float32(0.0)
