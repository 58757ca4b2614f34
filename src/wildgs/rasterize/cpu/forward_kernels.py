"""Numba (njit) kernels that blend tiles front to back.

A tile of 16 x 16 pixels is sixteen blocks of 4 x 4; a block is one vector. For each Gaussian of the tile's list
only the blocks that it reaches and that still let light through are visited.

A block's numbers lie together in memory: transmittance, alpha and depth sums, then the channels' sums.
Transmittance doubles as the pixels' state: negative where the pixel is saturated (its value is the
magnitude) or outside the picture.
"""

from __future__ import annotations

import numpy as np

from wildgs.kernel_cache import njit
from wildgs.rasterize.cpu.picture_kernels import PATCH, aligned, ask_for_tile, close_tile, open_tile
from wildgs.rasterize.cpu.reach_kernels import HALF, MIN_LEVEL, REACH, RECORD, TILE, nearest_exponent
from wildgs.rasterize.cpu.simd import (
    LANES,
    fma,
    lane_x,
    lane_y,
    lowest_bit,
    mask_bits,
    select,
    splat,
    vexp2,
    vmax,
    vmin,
)
from wildgs.rasterize.cpu.simd_memory import prefetch, vload, vstore
from wildgs.threads import fetch_add

PIXELS = TILE * TILE
# A tile's list is worked off in batches: all of a batch's Gaussians for one block,
# whose sums stay in registers.
BATCH = 64
AHEAD = 16  # list entries between asking for a Gaussian's numbers and using them
X, Y, QA, QB, QC, LEVEL, Y_PER_X, X_PER_Y, DEPTH, RED, GREEN, BLUE = tuple(range(0, 12 * BATCH, BATCH))
FIELDS = 12
MAX_ALPHA = np.float32(0.999)
MIN_TRANSMITTANCE = np.float32(1e-4)


@njit(nogil=True)
def load_batch(begin, count, entries, records, values, channels, tx, ty, batch):
    """Copies the numbers of `count` Gaussians of a tile's list into rows of BATCH floats (see X to BLUE).

    They lie scattered in memory: they are asked for ahead of time.
    """
    origin_x, origin_y = np.float32(tx * TILE) + HALF, np.float32(ty * TILE) + HALF
    row = channels + 1
    for i in range(count):
        soon = entries[min(2 * (begin + i + AHEAD), entries.size - 2)]
        prefetch(records, soon * RECORD)
        prefetch(values, soon * row)
        rank = entries[2 * (begin + i)]
        r, v = rank * RECORD, rank * row
        batch[X + i] = origin_x - records[r]
        batch[Y + i] = origin_y - records[r + 1]
        batch[QA + i], batch[QB + i], batch[QC + i] = (records[r + 2], records[r + 3], records[r + 4])
        batch[LEVEL + i] = records[r + 5]
        batch[Y_PER_X + i], batch[X_PER_Y + i] = records[r + 6], records[r + 7]
        batch[DEPTH + i] = values[v]
        if channels == 3:
            batch[RED + i], batch[GREEN + i], batch[BLUE + i] = (values[v + 1], values[v + 2], values[v + 3])


@njit(nogil=True)
def reach_by_block(count, batch, words):
    """For each block of the tile a word with a bit for every Gaussian of the batch that reaches it."""
    words[:] = 0
    four, three = np.float32(4.0), np.float32(3.0)
    for group in range(0, count, LANES):
        valid = (1 << min(count - group, LANES)) - 1
        x, y, level = (vload(batch, X + group), vload(batch, Y + group), vload(batch, LEVEL + group))
        A, B, C = (vload(batch, QA + group), vload(batch, QB + group), vload(batch, QC + group))
        y_per_x, x_per_y = vload(batch, Y_PER_X + group), vload(batch, X_PER_Y + group)
        for row in range(4):
            y0 = y + four * np.float32(row)
            for column in range(4):
                x0 = x + four * np.float32(column)
                best = nearest_exponent(x0, y0, x0 + three, y0 + three, A, B, C, y_per_x, x_per_y)
                words[row * 4 + column] |= (mask_bits(best + level >= REACH) & valid) << group


@njit(nogil=True)
def blend_forward(
    counter, tile_order, offsets, entries, records, values, channels, with_depth, background,
    width, height, out_colors, out_depth, out_alpha, final_transmittance, last,
):  # fmt: skip
    """Blends all tiles.

    `final_transmittance` and `last` (the last blended position in the tile's list, from 1) are laid out by tile
    and block for the backward pass; they are None where there will be none.
    """
    tiles_x = (width + TILE - 1) // TILE
    stride = (channels + 3) * LANES
    sums = aligned(16 * stride)
    reached = aligned(PIXELS)
    patch = aligned(PATCH)
    batch = aligned(FIELDS * BATCH)
    words = np.empty(16, np.int64)
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
        reached[:] = 0.0
        begin, end = offsets[tile], offsets[tile + 1]
        for start in range(begin, end, BATCH):
            if alive == 0:
                break
            count = min(BATCH, end - start)
            load_batch(start, count, entries, records, values, channels, tx, ty, batch)
            reach_by_block(count, batch, words)
            for block in range(16):
                word = words[block]
                if (alive >> block) & 1 == 0 or word == 0:
                    continue
                at = block * stride
                px = lane_x() + np.float32((block & 3) * 4)
                py = lane_y() + np.float32((block >> 2) * 4)
                before, total, depth = vload(sums, at), vload(sums, at + LANES), vload(sums, at + 2 * LANES)
                hits = vload(reached, block * LANES)
                red, green, blue = splat(0.0), splat(0.0), splat(0.0)
                if channels == 3:
                    red, green = vload(sums, at + 3 * LANES), vload(sums, at + 4 * LANES)
                    blue = vload(sums, at + 5 * LANES)
                while word != 0:
                    i = lowest_bit(word)
                    word &= word - 1
                    dx, dy = px + batch[X + i], py + batch[Y + i]
                    exponent = fma(
                        dx, fma(dx, batch[QA + i], dy * batch[QB + i]),
                        fma(dy * batch[QC + i], dy, batch[LEVEL + i]),
                    )  # fmt: skip
                    hit = (exponent >= MIN_LEVEL) & (before > 0.0)
                    alpha = vmin(vexp2(exponent), MAX_ALPHA)
                    weight = before * alpha
                    after = before - weight
                    kept = hit & (after > MIN_TRANSMITTANCE)
                    weight = select(kept, weight, 0.0)
                    total = total + weight
                    before = select(kept, after, select(hit, -before, before))
                    if last is not None:
                        hits = select(kept, splat(np.float32(start - begin + i + 1)), hits)
                    if with_depth:
                        depth = fma(weight, batch[DEPTH + i], depth)
                    if channels == 3:
                        red = fma(weight, batch[RED + i], red)
                        green = fma(weight, batch[GREEN + i], green)
                        blue = fma(weight, batch[BLUE + i], blue)
                    else:
                        first = (channels + 1) * entries[2 * (start + i)] + 1
                        for k in range(channels):
                            to = at + (k + 3) * LANES
                            vstore(sums, to, fma(weight, values[first + k], vload(sums, to)))
                vstore(sums, at, before)
                vstore(sums, at + LANES, total)
                vstore(sums, at + 2 * LANES, depth)
                vstore(reached, block * LANES, hits)
                if channels == 3:
                    vstore(sums, at + 3 * LANES, red)
                    vstore(sums, at + 4 * LANES, green)
                    vstore(sums, at + 5 * LANES, blue)
                if mask_bits(before > 0.0) == 0:
                    alive &= ~(1 << block)
        close_tile(
            tx, ty, width, height, channels, with_depth, background, stride, sums, patch,
            out_colors, out_depth, out_alpha,
        )  # fmt: skip
        if last is not None:
            for block in range(16):
                transmittance = vload(sums, block * stride)
                to = tile * PIXELS + block * LANES
                vstore(final_transmittance, to, vmax(transmittance, -transmittance))
                vstore(last, to, vload(reached, block * LANES))
