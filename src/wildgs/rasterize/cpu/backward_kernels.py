"""Numba (njit) kernels of the blend's gradient: tiles back to front, then a sum per Gaussian.

With w_i = alpha_i T_i and g_i = the pixel's gradients dotted with what Gaussian i brings (colour, depth, 1), the
loss is linear in the w_i, so d loss / d alpha_i = T_i g_i - (sum of w_j g_j behind i) / (1 - alpha_i).
With q = alpha d loss / d alpha (the gradient of ln alpha), everything that the Gaussian's centre,
conic and opacity need are the moments sum q, sum q u, sum q v, sum q u^2, sum q u v, sum q v^2 (u and v: see
`reach_kernels.RECORD`), which add up over tiles. Each (tile, Gaussian) pair writes its row of moments once and a
second pass adds each Gaussian's rows in a fixed order: no atomics, the same result for any number of threads.
"""

from __future__ import annotations

import numpy as np

from wildgs.kernel_cache import njit
from wildgs.rasterize.cpu.forward_kernels import AHEAD, MAX_ALPHA, PIXELS
from wildgs.rasterize.cpu.picture_kernels import PATCH, aligned, ask_for_tile, load_block
from wildgs.rasterize.cpu.reach_kernels import HALF, MIN_LEVEL, RECORD, TILE
from wildgs.rasterize.cpu.simd import (
    LANES,
    SUM_LANES,
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
    vratio,
)
from wildgs.rasterize.cpu.simd_memory import prefetch, prefetch_to_write, vload, vspread, vstore
from wildgs.threads import fetch_add

# A pair's row: one vector of sums (moments, depth, three colours, and |d x|, |d y| for absgrad), each in the lane
# where `lane_sums` puts it. Where there are not three colours, they follow; whole vectors.
Q, QU, QV, QUU, QUV, QVV, Q_DEPTH, Q_RED, Q_GREEN, Q_BLUE, ABS_X, ABS_Y = SUM_LANES
ROW_COLORS = 16
# A block's numbers lie together: transmittance behind what was visited so far, then at these offsets the sum of w g
# behind, the last position before the pixel was saturated, and the gradients of accumulated alpha, depth sum and
# colours.
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
    width, height, masks, final_transmittance, last, out_depth, out_alpha, v_colors, v_depth, v_alpha,
    row_size, rows, absgrad,
):  # fmt: skip
    """Writes one row of `row_size` floats per (tile, Gaussian) pair into `rows`, at the pair's slot."""
    tiles_x = (width + TILE - 1) // TILE
    stride = V_COLORS + channels * LANES
    v = aligned(16 * stride)
    v_color = aligned(channels * LANES)
    patch, farthest = aligned(PATCH), aligned(16)
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
            for k in range(0, row_size, LANES):
                vstore(rows, at + k, splat(0.0))
        gather_tile(
            begin, end, np.float32(tx * TILE) + HALF, np.float32(ty * TILE) + HALF, entries, records, values, masks,
            farthest, channels, with_depth, absgrad, stride, v, places, v_color, row_size, rows,
        )  # fmt: skip


@njit(nogil=True)
def gather_tile(
    begin, end, origin_x, origin_y, entries, records, values, masks, farthest,
    channels, with_depth, absgrad, stride, v, places, v_color, row_size, rows,
):  # fmt: skip
    """Sums each Gaussian's gradients over the blocks that it reaches in a tile, into the pair's row.

    A function of its own because arrays that a function is given are not counted, in loops, as references to them.
    """
    zero = splat(0.0)
    for p in range(begin + end - 1, begin - 1, -1):
        soon = max(p - AHEAD, 0)
        prefetch(records, np.int64(entries[2 * soon]) * RECORD)
        prefetch(values, np.int64(entries[2 * soon]) * (channels + 1))
        prefetch_to_write(rows, np.int64(entries[2 * soon + 1]) * row_size)
        position = splat(np.float32(p - begin + 1))
        blocks = np.int64(masks[p]) & mask_bits(vload(farthest, 0) >= position)
        rank, to = np.int64(entries[2 * p]), np.int64(entries[2 * p + 1]) * row_size
        r = rank * RECORD
        x, y = origin_x - records[r], origin_y - records[r + 1]
        a, b, d = records[r + 2], records[r + 3], records[r + 4]
        first_u, first_v = splat(a * x + b * y), splat(d * y)
        level = vspread(records, r + 5)
        first = rank * (channels + 1)
        depth, red, green, blue = vspread(values, first), zero, zero, zero
        if channels == 3:
            red, green, blue = (
                vspread(values, first + 1),
                vspread(values, first + 2),
                vspread(values, first + 3),
            )
        q0, qu, qv, quu, quv, qvv = zero, zero, zero, zero, zero, zero
        abs_x, abs_y, v_d, v_red, v_green, v_blue = zero, zero, zero, zero, zero, zero
        if channels != 3:
            v_color[:] = 0.0
        while blocks != 0:
            block = lowest_bit(blocks)
            blocks &= blocks - 1
            at = block * stride
            px, py = vload(places, block * 2 * LANES), vload(places, block * 2 * LANES + LANES)
            # As in the forward pass, to the last bit, so that both see the same hits.
            u_, v_ = fma(px, a, fma(py, b, first_u)), fma(py, d, first_v)
            exponent = fma(-u_, u_, fma(-v_, v_, level))
            hit = (exponent >= MIN_LEVEL) & (vload(v, at + REACHED) >= position)
            raw = vexp2(exponent)
            alpha = select(hit, vmin(raw, MAX_ALPHA), zero)
            # T = T_behind / (1 - alpha), so that alpha T = ratio T_behind and T = T_behind + alpha T.
            ratio = vratio(alpha, 1.0 - alpha)
            behind = vload(v, at)
            weight = ratio * behind
            vstore(v, at, behind + weight)
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
                    pull = fma(vk, vspread(values, first + 1 + k), pull)
                    vstore(v_color, k * LANES, fma(weight, vk, vload(v_color, k * LANES)))
            rest, gain = vload(v, at + BEHIND), weight * pull
            vstore(v, at + BEHIND, rest + gain)
            # Where alpha is capped it does not move with its exponent.
            q = select(raw <= MAX_ALPHA, fma(-ratio, rest, gain), zero)
            qu1, qv1 = q * u_, q * v_
            q0, qu, qv = q0 + q, qu + qu1, qv + qv1
            quu, quv, qvv = fma(qu1, u_, quu), fma(qu1, v_, quv), fma(qv1, v_, qvv)
            if absgrad:
                # Per pixel the exponent moves by -2 a u in x and -2 (b u + d v) in y; the factor comes at the end.
                ax, ay = a * qu1, fma(qu1, b, qv1 * d)
                abs_x, abs_y = abs_x + vmax(ax, -ax), abs_y + vmax(ay, -ay)
        vstore(rows, to, lane_sums((
            q0, qu, qv, quu, quv, qvv, v_d, v_red, v_green, v_blue, abs_x, abs_y
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
    counter, chunk_size, ranks, starts, row_size, rows, channels, records, opacities,
    v_means2d, v_conics, v_opacities, v_depths, v_colors, v_absolute,
):  # fmt: skip
    """Adds each Gaussian's rows and turns moments into gradients of centre, conic and opacity."""
    n = opacities.size
    total = aligned(row_size)
    two_ln2, half = np.float32(2 * 0.6931471805599453), np.float32(0.5)
    zero, one = np.float32(0.0), np.float32(1.0)
    while True:
        first = fetch_add(counter, 1) * chunk_size
        if first >= n:
            break
        for g in range(first, min(first + chunk_size, n)):
            soon = max(ranks[min(g + AHEAD, n - 1)], 0)
            prefetch(records, RECORD * soon)
            prefetch(rows, starts[soon] * row_size)
            prefetch(rows, (starts[soon + 1] - 1) * row_size)
            rank = ranks[g]
            total[:] = 0.0
            a, b, d = one, zero, one
            if rank >= 0:
                for at in range(starts[rank] * row_size, starts[rank + 1] * row_size, row_size):
                    for k in range(0, row_size, LANES):
                        vstore(total, k, vload(total, k) + vload(rows, at + k))
                r = rank * RECORD
                a, b, d = records[r + 2], records[r + 3], records[r + 4]
            # d ln alpha / d centre = 2 ln 2 (a u, b u + d v), and u = a dx + b dy, v = d dy.
            v_means2d[2 * g] = two_ln2 * a * total[QU]
            v_means2d[2 * g + 1] = two_ln2 * (b * total[QU] + d * total[QV])
            x_u, x_v, y_v = one / a, -b / (a * d), one / d
            dx_dv = x_u * total[QUV] + x_v * total[QVV]
            v_conics[3 * g] = -half * (x_u * (x_u * total[QUU] + x_v * total[QUV]) + x_v * dx_dv)
            v_conics[3 * g + 1] = -y_v * dx_dv
            v_conics[3 * g + 2] = -half * y_v * y_v * total[QVV]
            v_opacities[g] = total[Q] / opacities[g] if zero < opacities[g] <= 1.0 else zero
            v_depths[g] = total[Q_DEPTH]
            if channels == 3:
                v_colors[3 * g], v_colors[3 * g + 1] = total[Q_RED], total[Q_GREEN]
                v_colors[3 * g + 2] = total[Q_BLUE]
            else:
                for k in range(channels):
                    v_colors[channels * g + k] = total[ROW_COLORS + k]
            if v_absolute is not None:
                v_absolute[2 * g] += two_ln2 * total[ABS_X]
                v_absolute[2 * g + 1] += two_ln2 * total[ABS_Y]
