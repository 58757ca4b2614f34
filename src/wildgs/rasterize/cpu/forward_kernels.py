"""Numba (njit) kernels that blend tiles front to back.

A tile of 16 x 16 pixels is sixteen blocks of 4 x 4; a block is one vector. For each Gaussian of the tile's list
only the blocks that it reaches and that still let light through are visited.

A block's numbers lie together in memory: transmittance, columns, alpha and depth sums, then the channels' sums.
Pixels that are saturated or outside the picture have the column `CLOSED`, so far away that no Gaussian reaches it:
the loop needs no further test for them.
"""

from __future__ import annotations

import numpy as np

from wildgs.kernel_cache import njit
from wildgs.rasterize.cpu.picture_kernels import (
    CLOSED,
    COLORS,
    PATCH,
    aligned,
    ask_for_tile,
    close_tile,
    open_tile,
)
from wildgs.rasterize.cpu.reach_kernels import HALF, MIN_LEVEL, RECORD, TILE, reach
from wildgs.rasterize.cpu.simd import (
    LANES,
    fma,
    lane_y,
    lowest_bit,
    mask_bits,
    select,
    splat,
    vexp2,
    vmin,
)
from wildgs.rasterize.cpu.simd_memory import byte_bits, copy4, copy8, prefetch, vload, vspread, vstore
from wildgs.threads import fetch_add

PIXELS = TILE * TILE
# A tile's list is worked off in batches: all of a batch's Gaussians for one block,
# whose sums stay in registers. A bit per Gaussian takes two words: longer batches load and store sums less often.
WORD = 64
BATCH = 2 * WORD
AHEAD = 16  # list entries between asking for a Gaussian's numbers and using them
# A Gaussian in a batch: its record (see `reach_kernels.RECORD`) with the tile's first pixel centre minus the
# Gaussian's in place of its centre, depth and colours, then u and v at that pixel.
FIELDS = 16
X, Y, A, B, D, LEVEL, Y_PER_X, X_PER_Y, DEPTH, RED, GREEN, BLUE, U, V = range(14)
MAX_ALPHA = np.float32(0.999)
MIN_TRANSMITTANCE = np.float32(1e-4)


@njit(nogil=True)
def load_batch(begin, count, entries, records, values, channels, tx, ty, batch, masks, halves):
    """Copies `count` Gaussians of a tile's list into rows of `batch` and finds which blocks each reaches.

    They lie scattered in memory: they are asked for ahead of time.
    """
    origin_x, origin_y = np.float32(tx * TILE) + HALF, np.float32(ty * TILE) + HALF
    row = channels + 1
    for i in range(count):
        soon = entries[min(2 * (begin + i + AHEAD), entries.size - 2)]
        prefetch(records, soon * RECORD)
        prefetch(values, soon * row)
        rank, at = np.int64(entries[2 * (begin + i)]), i * FIELDS
        copy8(batch, at, records, rank * RECORD)
        if channels == 3:
            copy4(batch, at + DEPTH, values, rank * row)
        else:
            batch[at + DEPTH] = values[rank * row]
        x, y = origin_x - batch[at + X], origin_y - batch[at + Y]
        a, b, d = batch[at + A], batch[at + B], batch[at + D]
        batch[at + U], batch[at + V] = a * x + b * y, d * y
        bits = reach(
            x, y, np.float32(4.0), a, b, d, batch[at + LEVEL], batch[at + Y_PER_X], batch[at + X_PER_Y]
        )
        masks[begin + i] = bits
        halves[i], halves[BATCH + i] = bits & 0xFF, bits >> 8


@njit(nogil=True)
def by_block(count, halves, words):
    """For each block of the tile two words with a bit for every Gaussian of the batch that reaches it.

    `halves` holds the lower bytes of the batch's masks, then the upper ones: a vector of bytes is one word.
    """
    for group in range(2):
        left = count - group * WORD
        valid = np.int64(-1) if left >= WORD else (np.int64(1) << max(left, 0)) - 1
        for block in range(16):
            at = (block >> 3) * BATCH + group * WORD
            words[16 * group + block] = byte_bits(halves, at, block & 7) & valid


@njit(nogil=True)
def blend_forward(
    counter, tile_order, offsets, entries, records, values, channels, with_depth, background,
    width, height, out_colors, out_depth, out_alpha, masks, final_transmittance, last,
):  # fmt: skip
    """Blends all tiles.

    `masks` takes for each pair a bit per block that the Gaussian reaches; it is LANES longer than there are pairs.

    `final_transmittance` and `last` (the last position in the tile's list, from 1, before the pixel was saturated)
    are laid out by tile and block for the backward pass; they are empty where there will be none (not None, for
    which the kernel would be compiled a second time).
    """
    tiles_x = (width + TILE - 1) // TILE
    stride = (channels + COLORS) * LANES
    sums = aligned(16 * stride)
    reached = aligned(PIXELS)
    patch = aligned(PATCH)
    batch = aligned(FIELDS * BATCH)
    halves = np.empty(2 * BATCH, np.uint8)
    words = np.empty(32, np.int64)
    while True:
        item = fetch_add(counter, 1)
        if item >= tile_order.size:
            break
        tile = tile_order[item]
        tx, ty = tile % tiles_x, tile // tiles_x
        ask_for_tile(tx, ty, width, height, channels, out_colors, True)
        ask_for_tile(tx, ty, width, height, 1, out_alpha, True)
        if with_depth:
            ask_for_tile(tx, ty, width, height, 1, out_depth, True)
        alive = open_tile(tx, ty, width, height, stride, sums)
        begin, end = offsets[tile], offsets[tile + 1]
        for block in range(16):
            inside = vload(sums, block * stride + LANES) < CLOSED
            vstore(reached, block * LANES, select(inside, np.float32(end - begin), 0.0))
        for start in range(begin, end, BATCH):
            if alive == 0:
                break
            count = min(BATCH, end - start)
            load_batch(start, count, entries, records, values, channels, tx, ty, batch, masks, halves)
            by_block(count, halves, words)
            for block in range(16):
                word, later, first = words[block], words[16 + block], 0
                if word == 0:
                    word, later, first = later, 0, WORD
                if (alive >> block) & 1 == 0 or word == 0:
                    continue
                at = block * stride
                py = lane_y() + np.float32((block >> 2) * 4)
                before, px = vload(sums, at), vload(sums, at + LANES)
                total, depth = vload(sums, at + 2 * LANES), vload(sums, at + 3 * LANES)
                red, green, blue = splat(0.0), splat(0.0), splat(0.0)
                if channels == 3:
                    red, green = vload(sums, at + COLORS * LANES), vload(sums, at + (COLORS + 1) * LANES)
                    blue = vload(sums, at + (COLORS + 2) * LANES)
                while word != 0:
                    i = first + lowest_bit(word)
                    word &= word - 1
                    if word == 0:
                        word, later, first = later, 0, WORD
                    g = i * FIELDS
                    u = fma(px, vspread(batch, g + A), fma(py, vspread(batch, g + B), vspread(batch, g + U)))
                    v = fma(py, vspread(batch, g + D), vspread(batch, g + V))
                    exponent = fma(-u, u, fma(-v, v, vspread(batch, g + LEVEL)))
                    alpha = vmin(vexp2(exponent), MAX_ALPHA)
                    hit = exponent >= MIN_LEVEL
                    weight = select(hit, before * alpha, 0.0)
                    after = before - weight
                    full = after <= MIN_TRANSMITTANCE
                    if mask_bits(full) != 0:
                        px, after = select(full, CLOSED, px), select(full, before, after)
                        weight = select(full, 0.0, weight)
                        if last.size > 0:
                            visited = splat(np.float32(start - begin + i))
                            vstore(
                                reached, block * LANES, select(full, visited, vload(reached, block * LANES))
                            )
                    before, total = after, total + weight
                    if with_depth:
                        depth = fma(weight, vspread(batch, g + DEPTH), depth)
                    if channels == 3:
                        red = fma(weight, vspread(batch, g + RED), red)
                        green = fma(weight, vspread(batch, g + GREEN), green)
                        blue = fma(weight, vspread(batch, g + BLUE), blue)
                    else:
                        color = (channels + 1) * entries[2 * (start + i)] + 1
                        for k in range(channels):
                            to = at + (k + COLORS) * LANES
                            vstore(sums, to, fma(weight, vspread(values, color + k), vload(sums, to)))
                vstore(sums, at, before)
                vstore(sums, at + LANES, px)
                vstore(sums, at + 2 * LANES, total)
                vstore(sums, at + 3 * LANES, depth)
                if channels == 3:
                    vstore(sums, at + COLORS * LANES, red)
                    vstore(sums, at + (COLORS + 1) * LANES, green)
                    vstore(sums, at + (COLORS + 2) * LANES, blue)
                if mask_bits(px < CLOSED) == 0:
                    alive &= ~(1 << block)
        close_tile(
            tx, ty, width, height, channels, with_depth, background, stride, sums, patch,
            out_colors, out_depth, out_alpha,
        )  # fmt: skip
        if last.size > 0:
            for block in range(16):
                to = tile * PIXELS + block * LANES
                vstore(final_transmittance, to, vload(sums, block * stride))
                vstore(last, to, vload(reached, block * LANES))
