"""Numba (njit) kernels that make the tile lists: which Gaussians each tile blends, nearest first.

Gaussians come in any order. They are first put in order of the tile in which their box starts ("rank"), so that
what a tile and its neighbours read and write lies together in memory. Sorting by depth happens once, over the
Gaussians; a counting sort of their (tile, Gaussian) pairs keeps that order in every tile.

Counting sorts run on several threads: each chunk of the input counts for itself, `place_chunks` gives every
chunk its own places, and the result is that of one thread.
"""

from __future__ import annotations

import numpy as np

from wildgs.kernel_cache import njit
from wildgs.rasterize.cpu.footprint_kernels import GROUP
from wildgs.rasterize.cpu.reach_kernels import RECORD, inside_bits, window_mask
from wildgs.rasterize.cpu.simd import lowest_bit
from wildgs.rasterize.cpu.simd_memory import copy8, prefetch, prefetch_to_write
from wildgs.threads import fetch_add

AHEAD = 16  # items between asking for what an item needs and using it
SMALL = 0x33  # the bits of a window's first 2 x 2 tiles, all that most Gaussians reach
DIGIT = 12  # bits per radix pass, so that the counts stay in the fastest cache


@njit(nogil=True)
def home_tile(box, tiles_x):
    """The tile in which a box (see `project_kernels.pack_box`) starts."""
    return ((box >> 16) & 0xFFFF) * tiles_x + (box & 0xFFFF)


@njit(nogil=True)
def chunk_bounds(chunk, chunks, n):
    """First Gaussian of a chunk and the first after it, both at whole groups."""
    groups = (n + GROUP - 1) // GROUP
    return GROUP * (chunk * groups // chunks), min(GROUP * ((chunk + 1) * groups // chunks), n)


@njit(nogil=True)
def place_chunks(cursors, offsets):
    """Turns counts per (chunk, tile) into first positions, tile by tile and chunk by chunk."""
    at, tiles = 0, offsets.size - 1
    for tile in range(tiles):
        offsets[tile] = at
        for chunk in range(cursors.shape[0]):
            count = cursors[chunk, tile]
            cursors[chunk, tile] = at
            at += count
    offsets[tiles] = at


@njit(nogil=True)
def move_home(
    counter, tile_counts, boxes, masks, records, tiles_x, cursors, ranks, homes, ranked_records, spans
):
    """Gives Gaussians their ranks (-1: reaches no tile) and copies records, boxes, masks and counts there."""
    chunks, n = cursors.shape[0], tile_counts.size
    while True:
        chunk = fetch_add(counter, 1)
        if chunk >= chunks:
            break
        row = cursors[chunk]
        begin, end = chunk_bounds(chunk, chunks, n)
        for first in range(begin, end, AHEAD):
            # Ranks first, so that the places that they point to are on their way when they are written.
            for g in range(first, min(first + AHEAD, end)):
                ranks[g] = -1
                if tile_counts[g] > 0:
                    tile = home_tile(boxes[g], tiles_x)
                    rank = row[tile]
                    row[tile] = rank + 1
                    ranks[g] = rank
                    prefetch_to_write(homes, rank)
                    prefetch_to_write(spans, 4 * rank)
                    prefetch_to_write(ranked_records, RECORD * rank)
            for g in range(first, min(first + AHEAD, end)):
                rank = ranks[g]
                if rank >= 0:
                    homes[rank] = g
                    copy8(ranked_records, RECORD * rank, records, RECORD * g)
                    spans[4 * rank], spans[4 * rank + 1] = np.int32(boxes[g]), np.int32(boxes[g] >> 32)
                    spans[4 * rank + 2] = masks[g]
                    spans[4 * rank + 3] = tile_counts[g]


@njit(nogil=True)
def number_slots(spans, starts):
    """First slot of every rank's pairs (and after the last, their number)."""
    total = 0
    for rank in range(starts.size - 1):
        starts[rank] = total
        total += spans[4 * rank + 3]
    starts[starts.size - 1] = total
    return total


@njit(nogil=True)
def sort_by_depth(depths, tile_counts, keys, order, other_keys, other_order):
    """Gaussians that reach tiles, nearest first, at the same depth in their own order; in the array it returns.

    A radix sort of the bits of the positive depths less their minimum, so that a scene whose depths lie within a
    few octaves takes two or three passes.
    """
    bits = depths.view(np.uint32)
    low, high = np.uint32(0xFFFFFFFF), np.uint32(0)
    seen = 0
    for g in range(depths.size):
        if tile_counts[g] > 0:
            key = bits[g]
            keys[seen] = key
            order[seen] = g
            seen += 1
            low = min(low, key)
            high = max(high, key)
    span = int(high) - int(low)
    width = 0
    while span > 0 and (span >> width) > 0:
        width += 1
    passes = (width + DIGIT - 1) // DIGIT
    digit = (width + passes - 1) // max(passes, 1)
    for turn in range(passes):
        last = turn == passes - 1
        radix_pass(seen, low, keys, order, other_keys, other_order, turn * digit, digit, last)
        keys, other_keys = other_keys, keys
        order, other_order = other_order, order
    return order


@njit(nogil=True)
def radix_pass(count, low, keys, order, out_keys, out_order, shift, digit, last):
    """One stable counting sort by the `digit` bits from bit `shift` on of the keys less `low`.

    The last pass does not write keys, which nobody reads.
    """
    mask = (1 << digit) - 1
    cursor = np.zeros((1 << digit) + 1, np.int32)
    for i in range(count):
        cursor[(((int(keys[i]) - int(low)) >> shift) & mask) + 1] += 1
    for d in range(1, cursor.size):
        cursor[d] += cursor[d - 1]
    for i in range(count):
        d = ((int(keys[i]) - int(low)) >> shift) & mask
        at = cursor[d]
        cursor[d] = at + 1
        if not last:
            out_keys[at] = keys[i]
        out_order[at] = order[i]


@njit(nogil=True)
def count_pairs(counter, order, ranks, nearest, spans, records, tiles_x, cursors):
    """Pairs per (chunk of the depth order, tile), into `cursors`; the order as ranks, into `nearest`.

    Rows of `cursors` have tiles_x + 2 numbers more than there are tiles: a small box adds 0 to tiles that it does
    not reach, as a loop over those that it does is mispredicted at most Gaussians.
    """
    chunks, count = cursors.shape[0], order.size
    while True:
        chunk = fetch_add(counter, 1)
        if chunk >= chunks:
            break
        row = cursors[chunk]
        row[:] = 0
        for i in range(chunk * count // chunks, (chunk + 1) * count // chunks):
            prefetch(ranks, order[min(i + 2 * AHEAD, count - 1)])
            prefetch(spans, 4 * ranks[order[min(i + AHEAD, count - 1)]])
            rank = ranks[order[i]]
            nearest[i] = rank
            x0, y0 = spans[4 * rank] & 0xFFFF, spans[4 * rank] >> 16
            bits = int(spans[4 * rank + 2])
            first = y0 * tiles_x + x0
            if bits & ~SMALL == 0:
                row[first] += bits & 1
                row[first + 1] += (bits >> 1) & 1
                row[first + tiles_x] += (bits >> 4) & 1
                row[first + tiles_x + 1] += bits >> 5
                continue
            if bits >= 0:
                while bits != 0:
                    b = lowest_bit(bits)
                    bits &= bits - 1
                    row[first + (b >> 2) * tiles_x + (b & 3)] += 1
                continue
            x1, y1 = spans[4 * rank + 1] & 0xFFFF, spans[4 * rank + 1] >> 16
            for ty in range(y0, y1 + 1, 4):
                for tx in range(x0, x1 + 1, 4):
                    bits = window_mask(rank, records, tx, ty) & inside_bits(tx, ty, x1, y1)
                    while bits != 0:
                        b = lowest_bit(bits)
                        bits &= bits - 1
                        row[(ty + (b >> 2)) * tiles_x + tx + (b & 3)] += 1


@njit(nogil=True)
def write_pairs(counter, nearest, spans, records, starts, tiles_x, cursors, entries):
    """Writes each pair's rank and slot, tile by tile, nearest first; after the last there is room for one more."""
    spare = entries.size // 2 - 1
    chunks, count = cursors.shape[0], nearest.size
    while True:
        chunk = fetch_add(counter, 1)
        if chunk >= chunks:
            break
        row = cursors[chunk]
        for i in range(chunk * count // chunks, (chunk + 1) * count // chunks):
            soon = nearest[min(i + 2 * AHEAD, count - 1)]
            prefetch(spans, 4 * soon)
            prefetch(starts, soon)
            soon = 4 * np.int64(nearest[min(i + AHEAD, count - 1)])
            first = (spans[soon] >> 16) * tiles_x + (spans[soon] & 0xFFFF)
            # The places of most of its pairs; asking for the right ones alone would take branches.
            prefetch_to_write(entries, 2 * row[first])
            prefetch_to_write(entries, 2 * row[first + 1])
            prefetch_to_write(entries, 2 * row[first + tiles_x])
            rank = nearest[i]
            slot = starts[rank]
            x0, y0 = spans[4 * rank] & 0xFFFF, spans[4 * rank] >> 16
            bits, first = int(spans[4 * rank + 2]), y0 * tiles_x + x0
            if bits & ~SMALL == 0:
                slot = write_or_spare(bits & 1, first, rank, slot, row, entries, spare)
                slot = write_or_spare((bits >> 1) & 1, first + 1, rank, slot, row, entries, spare)
                slot = write_or_spare((bits >> 4) & 1, first + tiles_x, rank, slot, row, entries, spare)
                write_or_spare(bits >> 5, first + tiles_x + 1, rank, slot, row, entries, spare)
                continue
            if bits >= 0:
                write_window(bits, first, tiles_x, rank, slot, row, entries)
                continue
            x1, y1 = spans[4 * rank + 1] & 0xFFFF, spans[4 * rank + 1] >> 16
            for ty in range(y0, y1 + 1, 4):
                for tx in range(x0, x1 + 1, 4):
                    bits = window_mask(rank, records, tx, ty) & inside_bits(tx, ty, x1, y1)
                    slot = write_window(bits, ty * tiles_x + tx, tiles_x, rank, slot, row, entries)


@njit(nogil=True)
def write_or_spare(bit, tile, rank, slot, row, entries, spare):
    """Writes a pair to the tile's list if `bit` is 1, else to an unused slot, branch-free; returns the next."""
    at = row[tile]
    row[tile] = at + bit
    to = at if bit != 0 else spare
    entries[2 * to] = rank
    entries[2 * to + 1] = slot
    return slot + bit


@njit(nogil=True)
def write_window(bits, first, tiles_x, rank, slot, row, entries):
    """Writes a pair for each tile of a window of 4 x 4 whose bit is set; returns the next slot."""
    while bits != 0:
        b = lowest_bit(bits)
        bits &= bits - 1
        tile = first + (b >> 2) * tiles_x + (b & 3)
        at = row[tile]
        row[tile] = at + 1
        entries[2 * at] = rank
        entries[2 * at + 1] = slot
        slot += 1
    return slot


@njit(nogil=True)
def order_tiles(offsets, out):
    """Tiles in the order of processing, longest lists first, to balance the threads.

    Lengths are compared by their number of bits: tiles of similar length keep their order, for cache locality.
    """
    starts = np.zeros(66, np.int64)
    for tile in range(out.size):
        starts[64 - bit_length(offsets[tile + 1] - offsets[tile])] += 1
    total = 0
    for k in range(starts.size):
        starts[k], total = total, total + starts[k]
    for tile in range(out.size):
        k = 64 - bit_length(offsets[tile + 1] - offsets[tile])
        out[starts[k]] = tile
        starts[k] += 1


@njit(nogil=True)
def bit_length(number):
    """Number of binary digits of a number that is not negative; 0 for 0."""
    digits = 0
    while number > 0:
        number >>= 1
        digits += 1
    return digits


@njit(nogil=True)
def rank_values(counter, chunk_size, homes, depths, colors, channels, values):
    """Depth, then colours, of every rank: what blending adds up."""
    row = channels + 1
    while True:
        first = fetch_add(counter, 1) * chunk_size
        if first >= homes.size:
            break
        for rank in range(first, min(first + chunk_size, homes.size)):
            soon = homes[min(rank + AHEAD, homes.size - 1)]
            prefetch(depths, soon)
            prefetch(colors, channels * soon)
            g = homes[rank]
            values[rank * row] = depths[g]
            if channels == 3:  # without a loop of unknown length
                values[4 * rank + 1] = colors[3 * g]
                values[4 * rank + 2] = colors[3 * g + 1]
                values[4 * rank + 3] = colors[3 * g + 2]
                continue
            for k in range(channels):
                values[rank * row + 1 + k] = colors[channels * g + k]
