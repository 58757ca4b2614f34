"""Numba (njit) kernels of the blend's gradient: tiles back to front, then a sum per Gaussian.

With w_i = alpha_i T_i and g_i = the pixel's gradients dotted with what Gaussian i brings (colour, depth, 1), the
loss is linear in the w_i, so d loss / d alpha_i = T_i g_i - (sum of w_j g_j behind i) / (1 - alpha_i).
With q = alpha d loss / d alpha (the gradient of ln alpha), everything that the Gaussian's centre,
conic and opacity need are the moments sum q, sum q dx, sum q dy, sum q dx^2, sum q dx dy, sum q dy^2, which add up
over tiles. Each (tile, Gaussian) pair writes its row of moments once and a second pass adds each Gaussian's rows in
a fixed order: no atomics, the same result for any number of threads.
"""

from __future__ import annotations

import numpy as np

from wildgs.kernel_cache import njit
from wildgs.rasterize.cpu.forward_kernels import (
    AHEAD,
    BATCH,
    BLUE,
    DEPTH,
    FIELDS,
    GREEN,
    LEVEL,
    MAX_ALPHA,
    PIXELS,
    QA,
    QB,
    QC,
    RED,
    X_PER_Y,
    Y_PER_X,
    X,
    Y,
    load_batch,
)
from wildgs.rasterize.cpu.picture_kernels import PATCH, aligned, ask_for_tile, load_block
from wildgs.rasterize.cpu.reach_kernels import MIN_LEVEL, TILE, reach
from wildgs.rasterize.cpu.simd import (
    LANES,
    fma,
    lane_sums,
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
from wildgs.rasterize.cpu.simd_memory import prefetch, prefetch_to_write, vload, vstore
from wildgs.threads import fetch_add

# A pair's row: six moments, |d x|, |d y| (absgrad), depth, then colours; whole vectors.
ROW_ABS, ROW_DEPTH, ROW_COLORS = 6, 8, 9
# A block's numbers lie together: transmittance behind what was visited so far, then at these offsets the sum of w g
# behind, the last blended position, and the gradients of accumulated alpha, depth sum and colours.
BEHIND, REACHED, V_ALPHA, V_DEPTH, V_COLORS = 16, 32, 48, 64, 80


@njit(nogil=True)
def load_tile(
    tile, tx, ty, width, height, channels, with_depth, background, final_transmittance, last, out_depth, out_alpha,
    v_colors, v_depth, v_alpha, stride, patch, v,
):  # fmt: skip
    """Gathers a tile's state and incoming gradients by block (see the offsets at the top)."""
    for block in range(16):
        x, y, at = tx * TILE + (block & 3) * 4, ty * TILE + (block >> 2) * 4, block * stride
        vstore(v, at, vload(final_transmittance, tile * PIXELS + block * LANES))
        vstore(v, at + BEHIND, splat(0.0))
        vstore(v, at + REACHED, vload(last, tile * PIXELS + block * LANES))
        if x < width and y < height:
            load_block(
                x, y, width, height, channels, with_depth, background, out_depth, out_alpha,
                v_colors, v_depth, v_alpha, patch, v, at + V_ALPHA, at + V_DEPTH, at + V_COLORS,
            )  # fmt: skip


@njit(nogil=True)
def blend_backward(
    counter, tile_order, offsets, entries, records, values, channels, with_depth, background,
    width, height, final_transmittance, last, out_depth, out_alpha, v_colors, v_depth, v_alpha,
    row_size, rows, absgrad,
):  # fmt: skip
    """Writes one row of `row_size` floats per (tile, Gaussian) pair into `rows`, at the pair's slot."""
    tiles_x = (width + TILE - 1) // TILE
    stride = V_COLORS + channels * LANES
    v = aligned(16 * stride)
    v_color = aligned(channels * LANES)
    batch, patch = aligned(FIELDS * BATCH), aligned(PATCH)
    farthest = aligned(16)
    masks = np.empty(BATCH, np.int64)
    places = aligned(2 * PIXELS)
    for block in range(16):
        vstore(places, block * 2 * LANES, lane_x() + np.float32((block & 3) * 4))
        vstore(places, block * 2 * LANES + LANES, lane_y() + np.float32((block >> 2) * 4))
    following = fetch_add(counter, 1)
    while following < tile_order.size:
        # The next tile's pixels are asked for while this one is worked on.
        item, following = following, fetch_add(counter, 1)
        if following < tile_order.size:
            soon = tile_order[following]
            sx, sy = soon % tiles_x, soon // tiles_x
            ask_for_tile(sx, sy, width, height, channels, v_colors, False)
            ask_for_tile(sx, sy, width, height, 1, v_alpha, False)
            for i in range(0, PIXELS, LANES):
                prefetch(final_transmittance, soon * PIXELS + i)
                prefetch(last, soon * PIXELS + i)
            if with_depth:
                ask_for_tile(sx, sy, width, height, 1, v_depth, False)
                ask_for_tile(sx, sy, width, height, 1, out_depth, False)
                ask_for_tile(sx, sy, width, height, 1, out_alpha, False)
        tile = tile_order[item]
        tx, ty = tile % tiles_x, tile // tiles_x
        begin = offsets[tile]
        load_tile(
            tile, tx, ty, width, height, channels, with_depth, background, final_transmittance, last,
            out_depth, out_alpha,
            v_colors, v_depth, v_alpha, stride, patch, v,
        )  # fmt: skip
        end = 0
        for block in range(16):
            at = block * stride + REACHED
            farthest[block] = v[at : at + LANES].max()
            end = max(end, int(farthest[block]))
        for p in range(begin + end, offsets[tile + 1]):
            at = np.int64(entries[2 * p + 1]) * row_size
            for k in range(row_size):
                rows[at + k] = 0.0
        for stop in range(end, 0, -BATCH):
            start = max(stop - BATCH, 0)
            first = begin + start
            load_batch(first, stop - start, entries, records, values, channels, tx, ty, batch)
            for i in range(stop - start):
                prefetch_to_write(rows, np.int64(entries[2 * (first + i) + 1]) * row_size)
                masks[i] = mask_bits(vload(farthest, 0) >= np.float32(start + i + 1)) & reach(
                    batch[X + i], batch[Y + i], np.float32(4.0), batch[QA + i], batch[QB + i], batch[QC + i],
                    batch[LEVEL + i], batch[Y_PER_X + i], batch[X_PER_Y + i],
                )  # fmt: skip
            for i in range(stop - start - 1, -1, -1):
                rank, slot = entries[2 * (first + i)], np.int64(entries[2 * (first + i) + 1])
                gather_pair(
                    i, np.float32(start + i + 1), masks[i], batch, channels, with_depth, values, rank, absgrad,
                    stride, v, places, v_color, rows, slot * row_size,
                )  # fmt: skip


@njit(nogil=True, inline="always")
def gather_pair(
    i, position, blocks, batch, channels, with_depth, values, rank, absgrad, stride, v, places, v_color, rows, to
):  # fmt: skip
    """Sums one Gaussian's gradients over the blocks that it reaches in a tile, into its row at `to`."""
    zero = splat(0.0)
    x, y, level = splat(batch[X + i]), splat(batch[Y + i]), splat(batch[LEVEL + i])
    A, B, C = splat(batch[QA + i]), splat(batch[QB + i]), splat(batch[QC + i])
    depth, red, green, blue = (batch[DEPTH + i], batch[RED + i], batch[GREEN + i], batch[BLUE + i])
    q0, qx, qy, qxx, qxy, qyy = zero, zero, zero, zero, zero, zero
    abs_x, abs_y, v_d, v_red, v_green, v_blue = zero, zero, zero, zero, zero, zero
    if channels != 3:
        v_color[:] = 0.0
    while blocks != 0:
        block = lowest_bit(blocks)
        blocks &= blocks - 1
        at = block * stride
        dx, dy = (vload(places, block * 2 * LANES) + x, vload(places, block * 2 * LANES + LANES) + y)
        exponent = fma(dx, fma(dx, A, dy * B), fma(dy * C, dy, level))
        hit = (exponent >= MIN_LEVEL) & (vload(v, at + REACHED) >= position)
        raw = vexp2(exponent)
        alpha = select(hit, vmin(raw, MAX_ALPHA), zero)
        inverse = 1.0 / (1.0 - alpha)
        transmittance = vload(v, at) * inverse
        vstore(v, at, transmittance)
        weight = alpha * transmittance
        pull = vload(v, at + V_ALPHA)
        if with_depth:
            vd = vload(v, at + V_DEPTH)
            pull = fma(vd, depth, pull)
            v_d = fma(weight, vd, v_d)
        if channels == 3:
            v0, v1 = vload(v, at + V_COLORS), vload(v, at + V_COLORS + LANES)
            v2 = vload(v, at + V_COLORS + 2 * LANES)
            pull = fma(v0, red, fma(v1, green, fma(v2, blue, pull)))
            v_red, v_green, v_blue = (
                fma(weight, v0, v_red),
                fma(weight, v1, v_green),
                fma(weight, v2, v_blue),
            )
        else:
            for k in range(channels):
                vk = vload(v, at + V_COLORS + k * LANES)
                pull = fma(vk, values[(channels + 1) * rank + 1 + k], pull)
                vstore(v_color, k * LANES, fma(weight, vk, vload(v_color, k * LANES)))
        rest = vload(v, at + BEHIND)
        vstore(v, at + BEHIND, fma(weight, pull, rest))
        v_alpha_i = fma(transmittance, pull, -(rest * inverse))
        # Where alpha is capped it does not move with its exponent.
        q = select(raw <= MAX_ALPHA, alpha * v_alpha_i, zero)
        qdx, qdy = q * dx, q * dy
        q0, qx, qy = q0 + q, qx + qdx, qy + qdy
        qxx, qxy, qyy = fma(qdx, dx, qxx), fma(qdx, dy, qxy), fma(qdy, dy, qyy)
        if absgrad:
            # 2 A dx + B dy = -(a dx + b dy) / ln 2 with the conic's a and b; the factor comes at the end.
            ax, ay = fma(2.0 * A, qdx, B * qdy), fma(2.0 * C, qdy, B * qdx)
            abs_x, abs_y = abs_x + vmax(ax, -ax), abs_y + vmax(ay, -ay)
    vstore(rows, to, lane_sums((
        q0, qx, qy, qxx, qxy, qyy, abs_x, abs_y, v_d, v_red, v_green, v_blue, zero, zero, zero, zero
    )))  # fmt: skip
    if channels != 3:
        store_colors(rows, to + ROW_COLORS, v_color, channels)


@njit(nogil=True)
def store_colors(rows, at, v_color, channels):
    """The channels' part of a pair's row."""
    for k in range(channels):
        total = np.float32(0.0)
        for lane in range(LANES):
            total += v_color[k * LANES + lane]
        rows[at + k] = total


@njit(nogil=True)
def sum_rows(
    counter, chunk_size, ranks, starts, row_size, rows, channels, conics, opacities,
    v_means2d, v_conics, v_opacities, v_depths, v_colors, v_absolute,
):  # fmt: skip
    """Adds each Gaussian's rows and turns moments into gradients of centre, conic and opacity."""
    n = opacities.size
    total = aligned(row_size)
    ln2, half, zero = np.float32(0.6931471805599453), np.float32(0.5), np.float32(0.0)
    while True:
        first = fetch_add(counter, 1) * chunk_size
        if first >= n:
            break
        for g in range(first, min(first + chunk_size, n)):
            soon = max(ranks[min(g + AHEAD, n - 1)], 0)
            prefetch(rows, starts[soon] * row_size)
            prefetch(rows, (starts[soon + 1] - 1) * row_size)
            rank = ranks[g]
            total[:] = 0.0
            if rank >= 0:
                for at in range(starts[rank] * row_size, starts[rank + 1] * row_size, row_size):
                    for k in range(0, row_size, LANES):
                        vstore(total, k, vload(total, k) + vload(rows, at + k))
            a, b, c = conics[3 * g], conics[3 * g + 1], conics[3 * g + 2]
            # d ln alpha / d centre = conic (pixel - centre); dx is pixel minus centre.
            v_means2d[2 * g] = a * total[1] + b * total[2]
            v_means2d[2 * g + 1] = b * total[1] + c * total[2]
            v_conics[3 * g] = -half * total[3]
            v_conics[3 * g + 1] = -total[4]
            v_conics[3 * g + 2] = -half * total[5]
            v_opacities[g] = total[0] / opacities[g] if zero < opacities[g] <= 1.0 else zero
            v_depths[g] = total[ROW_DEPTH]
            for k in range(channels):
                v_colors[channels * g + k] = total[ROW_COLORS + k]
            if v_absolute is not None:
                v_absolute[2 * g] += ln2 * total[ROW_ABS]
                v_absolute[2 * g + 1] += ln2 * total[ROW_ABS + 1]
