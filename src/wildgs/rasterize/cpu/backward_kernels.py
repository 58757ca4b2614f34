"""Numba (njit) kernels of the blend's gradient: tiles back to front, then a sum per Gaussian.

With w_i = alpha_i T_i and g_i = the pixel's gradients dotted with what Gaussian i brings (colour, depth, 1), the
loss is linear in the w_i, so d loss / d alpha_i = T_i g_i - (sum of w_j g_j behind i) / (1 - alpha_i).
With q = -alpha d loss / d alpha (the gradient of the exponent's negative), everything that the Gaussian's centre,
conic and opacity need are the moments sum q, sum q dx, sum q dy, sum q dx^2, sum q dx dy, sum q dy^2, which add up
over tiles. Each (tile, Gaussian) pair writes its row of moments once and a second pass adds each Gaussian's rows in
a fixed order: no atomics, the same result for any number of threads.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from wildgs.rasterize.cpu.forward_kernels import HALF, MAX_ALPHA, MIN_LEVEL, PIXELS, RECORD, TILE
from wildgs.rasterize.cpu.simd import (
    fetch_add,
    fma,
    lane_sums,
    lane_x,
    lane_y,
    lowest_bit,
    select,
    splat,
    vexp2,
    vload,
    vmax,
    vmin,
    vstore,
)
from wildgs.rasterize.cpu.tile_kernels import reach

# A pair's row: six moments, |d x|, |d y| (absgrad), depth, then colours; whole vectors.
ROW_ABS, ROW_DEPTH, ROW_COLORS = 6, 8, 9
LANES = 16


@njit(nogil=True, cache=True)
def load_gradients(
    tx, ty, width, height, channels, with_depth, background, transmittance, out_depth, v_colors, v_depth, v_alpha, v
):  # fmt: skip
    """Gathers a tile's incoming gradients by block: colours, depth sum, then the accumulated alpha's."""
    v[:] = 0.0
    for row in range(min(TILE, height - ty * TILE)):
        for column in range(min(TILE, width - tx * TILE)):
            at = ((row >> 2) * 4 + (column >> 2)) * 16 + (row & 3) * 4 + (column & 3)
            pixel = (ty * TILE + row) * width + tx * TILE + column
            total = v_alpha[pixel]
            for k in range(channels):
                v[k * PIXELS + at] = v_colors[pixel * channels + k]
                total -= v_colors[pixel * channels + k] * background[k]
            alpha = np.float32(1.0) - transmittance[at]
            if with_depth and alpha > 0.0:
                share = v_depth[pixel] / alpha
                v[channels * PIXELS + at] = share
                total -= share * out_depth[pixel]
            v[(channels + 1) * PIXELS + at] = total


@njit(nogil=True, cache=True)
def blend_backward(
    counter, tile_order, offsets, ids, slots, records, depths, colors, channels, with_depth, background,
    width, height, final_transmittance, last, out_depth, v_colors, v_depth, v_alpha, stride, rows, absgrad,
):  # fmt: skip
    """Writes one row of `stride` floats per (tile, Gaussian) pair into `rows`, at the pair's slot."""
    tiles_x = (width + TILE - 1) // TILE
    state = np.empty(PIXELS, np.float32)
    behind = np.empty(PIXELS, np.float32)
    reached = np.empty(PIXELS, np.float32)
    farthest = np.empty(16, np.int64)
    v = np.empty((channels + 2) * PIXELS, np.float32)
    v_color = np.empty(channels * LANES, np.float32)
    zero = splat(0.0)
    while True:
        item = fetch_add(counter, 1)
        if item >= tile_order.size:
            break
        tile = tile_order[item]
        tx, ty = tile % tiles_x, tile // tiles_x
        begin = offsets[tile]
        for i in range(PIXELS):
            state[i] = final_transmittance[tile * PIXELS + i]
            reached[i] = last[tile * PIXELS + i]
        behind[:] = 0.0
        end = 0
        for block in range(16):
            farthest[block] = int(reached[block * 16 : block * 16 + 16].max())
            end = max(end, farthest[block])
        load_gradients(
            tx, ty, width, height, channels, with_depth, background, state, out_depth, v_colors, v_depth, v_alpha, v
        )  # fmt: skip
        for p in range(begin + end, offsets[tile + 1]):
            at = int(slots[p]) * stride
            for k in range(stride):
                rows[at + k] = 0.0
        for position in range(end, 0, -1):
            p = begin + position - 1
            g = ids[p]
            r = g * RECORD
            x = np.float32(tx * TILE) + HALF - records[r]
            y = np.float32(ty * TILE) + HALF - records[r + 1]
            A, B, C, level = records[r + 2], records[r + 3], records[r + 4], records[r + 5]
            blocks = reach(x, y, np.float32(4.0), A, B, C, level, records[r + 6], records[r + 7])
            q0, qx, qy, qxx, qxy, qyy = zero, zero, zero, zero, zero, zero
            abs_x, abs_y, v_d, red, green, blue = zero, zero, zero, zero, zero, zero
            v_color[:] = 0.0
            while blocks != 0:
                block = lowest_bit(blocks)
                blocks &= blocks - 1
                if farthest[block] < position:
                    continue
                at = block * 16
                dx = lane_x() + (x + np.float32((block & 3) * 4))
                dy = lane_y() + (y + np.float32((block >> 2) * 4))
                exponent = fma(dx, fma(dx, A, dy * B), fma(dy * C, dy, level))
                hit = (exponent >= MIN_LEVEL) & (vload(reached, at) >= np.float32(position))
                raw = vexp2(vmin(vmax(exponent, MIN_LEVEL), 0.0))
                alpha = select(hit, vmin(raw, MAX_ALPHA), zero)
                inverse = 1.0 / (1.0 - alpha)
                transmittance = vload(state, at) * inverse
                vstore(state, at, transmittance)
                weight = alpha * transmittance
                pull = vload(v, at + (channels + 1) * PIXELS)
                if channels == 3:
                    c = 3 * g
                    v0, v1, v2 = vload(v, at), vload(v, at + PIXELS), vload(v, at + 2 * PIXELS)
                    pull = fma(v0, colors[c], fma(v1, colors[c + 1], fma(v2, colors[c + 2], pull)))
                    red, green, blue = fma(weight, v0, red), fma(weight, v1, green), fma(weight, v2, blue)
                else:
                    for k in range(channels):
                        vk = vload(v, at + k * PIXELS)
                        pull = fma(vk, colors[channels * g + k], pull)
                        vstore(v_color, k * LANES, fma(weight, vk, vload(v_color, k * LANES)))
                if with_depth:
                    vd = vload(v, at + channels * PIXELS)
                    pull = fma(vd, depths[g], pull)
                    v_d = fma(weight, vd, v_d)
                rest = vload(behind, at)
                vstore(behind, at, fma(weight, pull, rest))
                v_alpha_i = fma(transmittance, pull, -(rest * inverse))
                # Where alpha is capped it does not move with its exponent.
                q = select(raw <= MAX_ALPHA, -(alpha * v_alpha_i), zero)
                qdx, qdy = q * dx, q * dy
                q0, qx, qy = q0 + q, qx + qdx, qy + qdy
                qxx, qxy, qyy = fma(qdx, dx, qxx), fma(qdx, dy, qxy), fma(qdy, dy, qyy)
                if absgrad:
                    # -ln 2 (2 A dx + B dy) = a dx + b dy with the conic's a and b; the factor comes at the end.
                    ax, ay = fma(2.0 * A, qdx, B * qdy), fma(2.0 * C, qdy, B * qdx)
                    abs_x, abs_y = abs_x + vmax(ax, -ax), abs_y + vmax(ay, -ay)
            at = int(slots[p]) * stride
            if channels == 3:
                vstore(rows, at, lane_sums((
                    q0, qx, qy, qxx, qxy, qyy, abs_x, abs_y, v_d, red, green, blue, zero, zero, zero, zero
                )))  # fmt: skip
            else:
                store_wide_row(
                    rows, at, v_color, channels, (q0, qx, qy, qxx, qxy, qyy, abs_x, abs_y, v_d)
                )  # fmt: skip


@njit(nogil=True, cache=True)
def store_wide_row(rows, at, v_color, channels, moments):
    """A pair's row for any number of channels: the moments' sums, then each channel's."""
    zero = splat(0.0)
    vstore(rows, at, lane_sums((
        moments[0], moments[1], moments[2], moments[3], moments[4], moments[5], moments[6], moments[7], moments[8],
        zero, zero, zero, zero, zero, zero, zero,
    )))  # fmt: skip
    for k in range(channels):
        total = np.float32(0.0)
        for lane in range(LANES):
            total += v_color[k * LANES + lane]
        rows[at + ROW_COLORS + k] = total


@njit(nogil=True, cache=True)
def sum_rows(
    counter, chunk_size, tile_counts, starts, stride, rows, channels, conics, opacities,
    v_means2d, v_conics, v_opacities, v_depths, v_colors, v_absolute,
):  # fmt: skip
    """Adds each Gaussian's rows and turns moments into gradients of centre, conic and opacity."""
    n = opacities.size
    total = np.empty(stride, np.float32)
    ln2 = np.float32(0.6931471805599453)
    while True:
        first = fetch_add(counter, 1) * chunk_size
        if first >= n:
            break
        for g in range(first, min(first + chunk_size, n)):
            count = tile_counts[g]
            if count == 0:
                v_means2d[2 * g] = v_means2d[2 * g + 1] = 0.0
                v_conics[3 * g] = v_conics[3 * g + 1] = v_conics[3 * g + 2] = 0.0
                v_opacities[g] = 0.0
                v_depths[g] = 0.0
                for k in range(channels):
                    v_colors[channels * g + k] = 0.0
                continue
            at = int(starts[g]) * stride
            for k in range(stride):
                total[k] = rows[at + k]
            for i in range(1, count):
                at += stride
                for k in range(stride):
                    total[k] += rows[at + k]
            a, b, c = conics[3 * g], conics[3 * g + 1], conics[3 * g + 2]
            # dx is pixel minus centre, so the centre moves it the other way.
            v_means2d[2 * g] = -(a * total[1] + b * total[2])
            v_means2d[2 * g + 1] = -(b * total[1] + c * total[2])
            v_conics[3 * g] = np.float32(0.5) * total[3]
            v_conics[3 * g + 1] = total[4]
            v_conics[3 * g + 2] = np.float32(0.5) * total[5]
            v_opacities[g] = -total[0] / opacities[g]
            v_depths[g] = total[ROW_DEPTH]
            for k in range(channels):
                v_colors[channels * g + k] = total[ROW_COLORS + k]
            if v_absolute is not None:
                v_absolute[2 * g] += ln2 * total[ROW_ABS]
                v_absolute[2 * g + 1] += ln2 * total[ROW_ABS + 1]
