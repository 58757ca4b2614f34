"""Numba (njit) kernels of the projection, sixteen Gaussians at a time, and the tiles that they reach.

Arrays are C-contiguous float32 and indexed flat. N must be at least 16: the last group overlaps the one before.
"""

from __future__ import annotations

import numpy as np

from wildgs.kernel_cache import njit
from wildgs.rasterize.cpu.footprint_kernels import (
    GROUP,
    LOG2_E,
    MIN_ALPHA,
    camera_numbers,
    cross,
    footprint,
)
from wildgs.rasterize.cpu.reach_kernels import (
    MIN_LEVEL,
    REACH,
    RECORD,
    count_bits,
    inside_bits,
    least_falloff,
    window_mask,
)
from wildgs.rasterize.cpu.simd import lowest_bit, mask_bits, select, splat, vfloor, vlog2, vmax, vmin, vsqrt
from wildgs.rasterize.cpu.simd_memory import vload, vload3, vstore, vstore2, vstore3, vstore8
from wildgs.rasterize.cpu.tile_kernels import chunk_bounds, home_tile
from wildgs.threads import fetch_add


@njit(nogil=True)
def project_forward(
    counter, means, quats, scales, opacities, view, lens, width, height, near,
    means2d, depths, conics, compensations, radii, records, boxes, masks, tile_counts, tiles_x, cursors,
):  # fmt: skip
    """Projects all Gaussians: centres, depths, conics, radii, blending records and the tiles that they reach.

    `cursors` takes the number of Gaussians that reach tiles per (chunk, home tile), for `tile_kernels.move_home`.

    If `lens` says antialiased, `compensations` takes what opacities are multiplied with; else it may be empty.

    A Gaussian's tiles lie in its box (first and last tile, inclusive; packed by `pack_box`); where the box is at
    most 4 x 4 tiles, its mask has a bit per tile that is reached, else it is -1.
    """
    n, chunks = depths.size, cursors.shape[0]
    spans = np.empty(7 * GROUP, np.float32)
    while True:
        chunk = fetch_add(counter, 1)
        if chunk >= chunks:
            break
        row = cursors[chunk]
        row[:] = 0
        begin, end = chunk_bounds(chunk, chunks, n)
        for start in range(begin, end, GROUP):
            i = min(start, n - GROUP)
            large = project_group(
                i, means, quats, scales, opacities, view, lens, width, height, near,
                means2d, depths, conics, compensations, records, spans,
            )  # fmt: skip
            for lane in range(GROUP):
                g = i + lane
                radii[g] = np.int32(spans[lane])
                boxes[g] = pack_box(
                    np.int64(spans[GROUP + lane]), np.int64(spans[2 * GROUP + lane]),
                    np.int64(spans[3 * GROUP + lane]), np.int64(spans[4 * GROUP + lane]),
                )  # fmt: skip
                masks[g], tile_counts[g] = (
                    np.int32(spans[5 * GROUP + lane]),
                    np.int32(spans[6 * GROUP + lane]),
                )
            while large != 0:
                lane = lowest_bit(large)
                large &= large - 1
                g = i + lane
                masks[g], tile_counts[g] = find_tiles(
                    g, np.int64(spans[GROUP + lane]), np.int64(spans[2 * GROUP + lane]),
                    np.int64(spans[3 * GROUP + lane]), np.int64(spans[4 * GROUP + lane]), records,
                )  # fmt: skip
            for g in range(start, i + GROUP):  # the last group overlaps the one before
                row[home_tile(boxes[g], tiles_x)] += min(tile_counts[g], 1)


@njit(nogil=True)
def pack_box(x0, y0, x1, y1):
    """First and last column and row of tiles in one number, so that it is moved at once."""
    return x0 | (y0 << 16) | (x1 << 32) | (y1 << 48)


@njit(nogil=True)
def find_tiles(g, x0, y0, x1, y1, records):
    """A Gaussian's mask, and how many tiles it reaches."""
    if x1 - x0 < 4 and y1 - y0 < 4:
        mask = window_mask(g, records, x0, y0) & inside_bits(x0, y0, x1, y1)
        return mask, count_bits(mask)
    count = 0
    for ty in range(y0, y1 + 1, 4):
        for tx in range(x0, x1 + 1, 4):
            count += count_bits(window_mask(g, records, tx, ty) & inside_bits(tx, ty, x1, y1))
    return -1, count


@njit(nogil=True)
def project_group(
    i, means, quats, scales, opacities, view, lens, width, height, near,
    means2d, depths, conics, compensations, records, spans,
):  # fmt: skip
    """Sixteen Gaussians from index i.

    `spans` takes radii, the boxes' first and last tiles, and masks and numbers of tiles where the box has at most
    2 x 2 tiles. Returns a bit per Gaussian whose box has more.
    """
    R = camera_numbers(view)
    px, py, pz = vload3(means, 3 * i)
    x = R[0] * px + R[1] * py + R[2] * pz + view[3]
    y = R[3] * px + R[4] * py + R[5] * pz + view[7]
    z = R[6] * px + R[7] * py + R[8] * pz + view[11]
    in_front = z > near
    iz = 1.0 / select(in_front, z, 1.0)

    u, _, _ = footprint(i, quats, scales, R, lens, width, height, x, y, z, iz)
    a = u[0] * u[0] + u[1] * u[1] + u[2] * u[2] + lens[4]
    b = u[0] * u[3] + u[1] * u[4] + u[2] * u[5]
    c = u[3] * u[3] + u[4] * u[4] + u[5] * u[5] + lens[4]
    determinant = a * c - b * b
    opacity = vload(opacities, i)
    if lens[5] > 0.0:
        n0, n1, n2 = cross(u)
        kept = (n0 * n0 + n1 * n1 + n2 * n2) / select(determinant > 0.0, determinant, 1.0)
        compensation = vsqrt(vmin(kept, 1.0))
        opacity = select(opacity < 1e6, vmin(opacity, 1.0), opacity) * compensation
    mx, my = lens[0] * x * iz + lens[2], lens[1] * y * iz + lens[3]

    # NaN fails every comparison, and infinity the upper bounds: what is not finite is culled here.
    sound = in_front & (z < 1e9) & (determinant > 0.0) & (determinant < 1e30) & (a < 1e15) & (c < 1e15)
    sound = sound & (opacity >= MIN_ALPHA) & (opacity < 1e6)
    level = vlog2(vmin(select(sound, opacity, 1.0), 1.0))
    reached = vmax(2.0 / LOG2_E * (level - MIN_LEVEL), 0.0)
    hx, hy = vsqrt(reached * a), vsqrt(reached * c)
    seen = sound & (mx + hx > 0.0) & (mx - hx < width) & (my + hy > 0.0) & (my - hy < height)

    zero = splat(0.0)
    scale = 1.0 / select(sound, determinant, 1.0)
    conic_a, conic_b, conic_c = c * scale, -b * scale, a * scale
    vstore(depths, i, select(seen, z, zero))
    if lens[5] > 0.0:
        vstore(compensations, i, select(seen, compensation, zero))
    vstore2(means2d, 2 * i, (select(seen, mx, zero), select(seen, my, zero)))
    vstore3(
        conics, 3 * i, (select(seen, conic_a, zero), select(seen, conic_b, zero), select(seen, conic_c, zero))
    )
    radius = vmin(-vfloor(-vmax(hx, hy)), 1e9)
    vstore(spans, 0, select(seen, vmax(radius, 1.0), zero))
    if mask_bits(seen) == 0:
        for k in range(GROUP, 7 * GROUP, GROUP):
            vstore(spans, k, zero)
        return 0
    # The conic's Cholesky factor from the covariance: d^2 as a difference of conics would lose a needle's digits.
    y_per_x, x_per_y = b / a, b / c
    factor_a, factor_d = vsqrt(0.5 * LOG2_E * select(sound, conic_a, 1.0)), vsqrt(0.5 * LOG2_E / c)
    factor_b = -x_per_y * factor_a
    vstore8(records, RECORD * i, (mx, my, factor_a, factor_b, factor_d, level, y_per_x, x_per_y))

    # Pixels whose centres lie in the ellipse's box, then their tiles; there may be no such pixel.
    left, top = -vfloor(-vmax(mx - hx - 0.5, 0.0)), -vfloor(-vmax(my - hy - 0.5, 0.0))
    right, bottom = (vfloor(vmin(mx + hx - 0.5, width - 1.0)), vfloor(vmin(my + hy - 0.5, height - 1.0)))
    seen = seen & (left <= right) & (top <= bottom)
    x0, y0 = (vfloor(select(seen, left, zero) * 0.0625), vfloor(select(seen, top, zero) * 0.0625))
    x1, y1 = (vfloor(select(seen, right, zero) * 0.0625), vfloor(select(seen, bottom, zero) * 0.0625))
    vstore(spans, GROUP, x0)
    vstore(spans, 2 * GROUP, y0)
    vstore(spans, 3 * GROUP, x1)
    vstore(spans, 4 * GROUP, y1)
    left, top = x0 * 16.0 + 0.5 - mx, y0 * 16.0 + 0.5 - my
    factor = (factor_a, factor_b, factor_d, y_per_x, x_per_y)
    limit = level - REACH
    near_x, near_y, far_x, far_y = left + 15.0, top + 15.0, left + 31.0, top + 31.0
    nn = least_falloff(left, top, near_x, near_y, *factor)
    fn = least_falloff(left + 16.0, top, far_x, near_y, *factor)
    nf = least_falloff(left, top + 16.0, near_x, far_y, *factor)
    ff = least_falloff(left + 16.0, top + 16.0, far_x, far_y, *factor)
    wide, tall = seen & (x1 > x0), seen & (y1 > y0)
    nn, fn = select(seen & (nn <= limit), splat(1.0), zero), select(wide & (fn <= limit), splat(1.0), zero)
    nf, ff = (
        select(tall & (nf <= limit), splat(1.0), zero),
        select(wide & tall & (ff <= limit), splat(1.0), zero),
    )
    vstore(spans, 5 * GROUP, nn + 2.0 * fn + 16.0 * nf + 32.0 * ff)
    vstore(spans, 6 * GROUP, nn + fn + nf + ff)
    return mask_bits(seen & ((x1 - x0 >= 2.0) | (y1 - y0 >= 2.0)))
