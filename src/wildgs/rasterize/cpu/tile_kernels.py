"""Numba (njit) kernels of tile lists: which tiles a Gaussian really reaches, in order of depth.

A Gaussian reaches a pixel where its alpha is at least 1/255: inside an ellipse. `reach` tests the ellipse
against sixteen squares at once, exactly: a Gaussian is listed for a tile only if its ellipse crosses the
rectangle of the tile's pixel centres.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from wildgs.rasterize.cpu.simd import fetch_add, fma, lane_x, lane_y, lowest_bit, mask_bits, vmax, vmin

TILE = 16
RECORD = 8
# log2(1/255), with slack for rounding: the pixels' own test decides.
REACH = np.float32(-7.99435344 - 0.01)


@njit(nogil=True, cache=True)
def reach(x, y, side, A, B, C, level, y_per_x, x_per_y):
    """Which squares of a 4 x 4 arrangement the Gaussian reaches, as 16 bits.

    Args:
        x: Centre of the arrangement's first pixel minus the Gaussian's, px.
        y: Likewise.
        side: Pixels along a square.
        A: With B, C and level: log2 alpha = A dx^2 + B dx dy + C dy^2 + level.
        B: See A.
        C: See A.
        level: See A.
        y_per_x: -B / 2C: where along a column alpha is largest.
        x_per_y: -B / 2A: where along a row alpha is largest.
    """
    x0 = lane_x() * side + x
    y0 = lane_y() * side + y
    x1 = x0 + (side - np.float32(1.0))
    y1 = y0 + (side - np.float32(1.0))
    # The largest alpha in a rectangle lies on the edge that faces the centre, horizontal or vertical.
    edge_x = vmin(vmax(x0, 0.0), x1)
    edge_y = vmin(vmax(y0, 0.0), y1)
    best_y = vmin(vmax(edge_x * y_per_x, y0), y1)
    best_x = vmin(vmax(edge_y * x_per_y, x0), x1)
    vertical = fma(edge_x, fma(A, edge_x, B * best_y), C * best_y * best_y)
    horizontal = fma(best_x, fma(A, best_x, B * edge_y), C * edge_y * edge_y)
    return mask_bits(vmax(vertical, horizontal) + level >= REACH)


@njit(nogil=True, cache=True)
def window_mask(g, records, tx, ty):
    """Bits of the 4 x 4 tiles from tile (tx, ty) that Gaussian g reaches."""
    r = g * RECORD
    return reach(
        np.float32(tx * TILE) + np.float32(0.5) - records[r],
        np.float32(ty * TILE) + np.float32(0.5) - records[r + 1],
        np.float32(TILE),
        records[r + 2], records[r + 3], records[r + 4], records[r + 5], records[r + 6], records[r + 7],
    )  # fmt: skip


@njit(nogil=True, cache=True)
def inside_bits(tx, ty, box_x1, box_y1):
    """Bits of a 4 x 4 window at (tx, ty) that lie within the box's last tile (box_x1, box_y1)."""
    columns = (1 << min(box_x1 - tx + 1, 4)) - 1
    rows = min(box_y1 - ty + 1, 4)
    return (columns * 0x1111) & ((1 << (4 * rows)) - 1)


@njit(nogil=True, cache=True)
def count_tiles(g, records, hx, hy, width, height, boxes):
    """Number of tiles that Gaussian g reaches; writes its box of tiles (x0, y0, x1, y1) into `boxes`."""
    mx, my = records[g * RECORD], records[g * RECORD + 1]
    half = np.float32(0.5)
    x0 = int(math.ceil(max(mx - hx - half, np.float32(0.0))))
    y0 = int(math.ceil(max(my - hy - half, np.float32(0.0))))
    x1 = int(math.floor(min(mx + hx - half, np.float32(width - 1))))
    y1 = int(math.floor(min(my + hy - half, np.float32(height - 1))))
    if x0 > x1 or y0 > y1:
        return 0
    x0, y0, x1, y1 = x0 // TILE, y0 // TILE, x1 // TILE, y1 // TILE
    boxes[4 * g], boxes[4 * g + 1], boxes[4 * g + 2], boxes[4 * g + 3] = x0, y0, x1, y1
    if x0 == x1 and y0 == y1:
        return 1
    count = 0
    for ty in range(y0, y1 + 1, 4):
        for tx in range(x0, x1 + 1, 4):
            bits = window_mask(g, records, tx, ty) & inside_bits(tx, ty, x1, y1)
            while bits != 0:
                bits &= bits - 1
                count += 1
    return count


@njit(nogil=True, cache=True)
def sort_by_depth(depths, tile_counts, starts):
    """Indices of the Gaussians that reach tiles, nearest first (stable), and where each one's pairs start.

    A radix sort of the bits of the positive depths, less their minimum, so that a scene whose depths lie within
    a few octaves takes two or three passes.
    """
    n = depths.size
    bits = depths.view(np.uint32)
    order = np.empty(n, np.int32)
    low, high = np.uint32(0xFFFFFFFF), np.uint32(0)
    seen = 0
    pairs = 0
    for g in range(n):
        starts[g] = pairs
        if tile_counts[g] > 0:
            pairs += tile_counts[g]
            order[seen] = g
            seen += 1
            low = min(low, bits[g])
            high = max(high, bits[g])
    order = order[:seen]
    if seen == 0:
        return order, pairs
    keys = np.empty(seen, np.uint32)
    for i in range(seen):
        keys[i] = bits[order[i]] - low
    span = int(high - low)
    width = 0
    while (span >> width) > 0:
        width += 1
    passes = (width + 12) // 13
    digit = (width + passes - 1) // max(passes, 1)
    other_order = np.empty(seen, np.int32)
    other_keys = np.empty(seen, np.uint32)
    for turn in range(passes):
        radix_pass(keys, order, other_keys, other_order, turn * digit, digit)
        keys, other_keys = other_keys, keys
        order, other_order = other_order, order
    return order, pairs


@njit(nogil=True, cache=True)
def radix_pass(keys, order, out_keys, out_order, shift, digit):
    """One stable counting sort by the `digit` bits from bit `shift` on."""
    mask = (1 << digit) - 1
    cursor = np.zeros((1 << digit) + 1, np.int32)
    for i in range(keys.size):
        cursor[((int(keys[i]) >> shift) & mask) + 1] += 1
    for d in range(1, cursor.size):
        cursor[d] += cursor[d - 1]
    for i in range(keys.size):
        d = (int(keys[i]) >> shift) & mask
        at = cursor[d]
        cursor[d] = at + 1
        out_keys[at] = keys[i]
        out_order[at] = order[i]


@njit(nogil=True, cache=True)
def count_pairs(counter, order, records, boxes, tiles_x, cursors):
    """Pairs per (chunk of the depth order, tile), into `cursors`."""
    chunks = cursors.shape[0]
    while True:
        chunk = fetch_add(counter, 1)
        if chunk >= chunks:
            break
        row = cursors[chunk]
        row[:] = 0
        for i in range(chunk * order.size // chunks, (chunk + 1) * order.size // chunks):
            g = order[i]
            x0, y0, x1, y1 = boxes[4 * g], boxes[4 * g + 1], boxes[4 * g + 2], boxes[4 * g + 3]
            if x0 == x1 and y0 == y1:
                row[y0 * tiles_x + x0] += 1
                continue
            for ty in range(y0, y1 + 1, 4):
                for tx in range(x0, x1 + 1, 4):
                    bits = window_mask(g, records, tx, ty) & inside_bits(tx, ty, x1, y1)
                    while bits != 0:
                        b = lowest_bit(bits)
                        bits &= bits - 1
                        row[(ty + (b >> 2)) * tiles_x + tx + (b & 3)] += 1


@njit(nogil=True, cache=True)
def place_chunks(cursors, offsets):
    """Turns counts per (chunk, tile) into first positions, tile by tile and chunk by chunk."""
    at = 0
    for tile in range(cursors.shape[1]):
        offsets[tile] = at
        for chunk in range(cursors.shape[0]):
            count = cursors[chunk, tile]
            cursors[chunk, tile] = at
            at += count
    offsets[cursors.shape[1]] = at


@njit(nogil=True, cache=True)
def write_pairs(counter, order, records, boxes, starts, tiles_x, cursors, ids, slots):
    """Writes each pair's Gaussian and its slot among that Gaussian's pairs, tile by tile, nearest first."""
    chunks = cursors.shape[0]
    while True:
        chunk = fetch_add(counter, 1)
        if chunk >= chunks:
            break
        row = cursors[chunk]
        for i in range(chunk * order.size // chunks, (chunk + 1) * order.size // chunks):
            g = order[i]
            slot = starts[g]
            x0, y0, x1, y1 = boxes[4 * g], boxes[4 * g + 1], boxes[4 * g + 2], boxes[4 * g + 3]
            for ty in range(y0, y1 + 1, 4):
                for tx in range(x0, x1 + 1, 4):
                    bits = inside_bits(tx, ty, x1, y1)
                    if x0 != x1 or y0 != y1:
                        bits &= window_mask(g, records, tx, ty)
                    while bits != 0:
                        b = lowest_bit(bits)
                        bits &= bits - 1
                        tile = (ty + (b >> 2)) * tiles_x + tx + (b & 3)
                        at = row[tile]
                        row[tile] = at + 1
                        ids[at] = g
                        slots[at] = slot
                        slot += 1
