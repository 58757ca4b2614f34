"""Numba (njit) kernels of the projection, sixteen Gaussians at a time, and its gradient.

Arrays are C-contiguous float32 and indexed flat. N must be at least 16: the last group overlaps the one before.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from wildgs.rasterize.cpu.reach_kernels import (
    MIN_LEVEL,
    REACH,
    RECORD,
    count_bits,
    inside_bits,
    nearest_exponent,
    window_mask,
)
from wildgs.rasterize.cpu.simd import (
    fetch_add,
    mask_bits,
    select,
    splat,
    vfloor,
    vload,
    vload2,
    vload3,
    vload4,
    vlog2,
    vmax,
    vmin,
    vsqrt,
    vstore,
    vstore2,
    vstore3,
    vstore4,
    vstore8,
)

GROUP = 16
CHUNK = 32  # groups that a thread takes at once
DILATION = 0.3  # px^2 on the covariance's diagonal, as gsplat's eps2d
MIN_ALPHA = 1.0 / 255.0
LOG2_E = 1.4426950408889634


@njit(nogil=True, cache=True)
def rotation(w, x, y, z):
    """Rotation matrix (rows) of a unit quaternion."""
    return (
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
        2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x),
        2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y),
    )  # fmt: skip


@njit(nogil=True, cache=True)
def matmul(a, b):
    """Product of two 3 x 3 matrices given as rows."""
    return (
        a[0] * b[0] + a[1] * b[3] + a[2] * b[6],
        a[0] * b[1] + a[1] * b[4] + a[2] * b[7],
        a[0] * b[2] + a[1] * b[5] + a[2] * b[8],
        a[3] * b[0] + a[4] * b[3] + a[5] * b[6],
        a[3] * b[1] + a[4] * b[4] + a[5] * b[7],
        a[3] * b[2] + a[4] * b[5] + a[5] * b[8],
        a[6] * b[0] + a[7] * b[3] + a[8] * b[6],
        a[6] * b[1] + a[7] * b[4] + a[8] * b[7],
        a[6] * b[2] + a[7] * b[5] + a[8] * b[8],
    )


@njit(nogil=True, cache=True)
def camera_numbers(view):
    """The world-to-camera rotation as a tuple, from the flat 3 x 4 matrix."""
    return (
        view[0],
        view[1],
        view[2],
        view[4],
        view[5],
        view[6],
        view[8],
        view[9],
        view[10],
    )


@njit(nogil=True, cache=True)
def clamp_limits(lens, width, height):
    """Bounds of x/z and y/z beyond which the projection's Jacobian is held: 0.3 half fields of view outside."""
    fx, fy, cx, cy = lens[0], lens[1], lens[2], lens[3]
    margin_x = np.float32(0.15) * width / fx
    margin_y = np.float32(0.15) * height / fy
    return (
        -(cx / fx + margin_x),
        (width - cx) / fx + margin_x,
        -(cy / fy + margin_y),
        (height - cy) / fy + margin_y,
    )


@njit(nogil=True, cache=True)
def project_forward(
    counter, means, quats, scales, opacities, view, lens, width, height, near,
    means2d, depths, conics, radii, records, boxes, masks, tile_counts,
):  # fmt: skip
    """Projects all Gaussians: centres, depths, conics, radii, blending records and the tiles that they reach.

    A Gaussian's tiles lie in its box (first and last tile, inclusive); where the box is at most 4 x 4 tiles, its
    mask has a bit per tile that is reached, else it is -1.
    """
    n = depths.size
    groups = (n + GROUP - 1) // GROUP
    spans = np.empty(7 * GROUP, np.float32)
    while True:
        first = fetch_add(counter, 1) * CHUNK
        if first >= groups:
            break
        for group in range(first, min(first + CHUNK, groups)):
            i = min(group * GROUP, n - GROUP)
            corners = project_group(
                i, means, quats, scales, opacities, view, lens, width, height, near,
                means2d, depths, conics, records, spans,
            )  # fmt: skip
            for lane in range(GROUP):
                g = i + lane
                radii[g] = np.int32(spans[lane])
                tile_counts[g] = 0
                if radii[g] > 0:
                    tile_counts[g] = find_tiles(g, lane, spans, corners, records, boxes, masks)


@njit(nogil=True, cache=True, inline="always")
def find_tiles(g, lane, spans, corners, records, boxes, masks):
    """Writes a Gaussian's box and mask; returns how many tiles it reaches."""
    x0, y0 = int(spans[GROUP + lane]), int(spans[2 * GROUP + lane])
    x1, y1 = int(spans[3 * GROUP + lane]), int(spans[4 * GROUP + lane])
    boxes[4 * g], boxes[4 * g + 1], boxes[4 * g + 2], boxes[4 * g + 3] = x0, y0, x1, y1
    if x1 - x0 < 2 and y1 - y0 < 2:
        nn, fn = (corners[0] >> lane) & 1, (corners[1] >> lane) & 1
        nf, ff = (corners[2] >> lane) & 1, (corners[3] >> lane) & 1
        masks[g] = nn | (fn << 1) | (nf << 4) | (ff << 5)
        return nn + fn + nf + ff
    if x1 - x0 < 4 and y1 - y0 < 4:
        mask = window_mask(g, records, x0, y0) & inside_bits(x0, y0, x1, y1)
        masks[g] = mask
        return count_bits(mask)
    masks[g] = -1
    count = 0
    for ty in range(y0, y1 + 1, 4):
        for tx in range(x0, x1 + 1, 4):
            count += count_bits(window_mask(g, records, tx, ty) & inside_bits(tx, ty, x1, y1))
    return count


@njit(nogil=True, cache=True)
def project_group(
    i, means, quats, scales, opacities, view, lens, width, height, near, means2d, depths, conics, records, spans
):  # fmt: skip
    """Sixteen Gaussians from index i.

    `spans` takes radii and the boxes' first and last tiles. Returns, for the box's first tile, the one to its right,
    the one below and the one beyond both, a bit per Gaussian that reaches it.
    """
    R = camera_numbers(view)
    px, py, pz = vload3(means, 3 * i)
    x = R[0] * px + R[1] * py + R[2] * pz + view[3]
    y = R[3] * px + R[4] * py + R[5] * pz + view[7]
    z = R[6] * px + R[7] * py + R[8] * pz + view[11]
    in_front = z > near
    iz = 1.0 / select(in_front, z, 1.0)

    u, _, _ = footprint(i, quats, scales, R, lens, width, height, x, y, z, iz)
    a = u[0] * u[0] + u[1] * u[1] + u[2] * u[2] + DILATION
    b = u[0] * u[3] + u[1] * u[4] + u[2] * u[5]
    c = u[3] * u[3] + u[4] * u[4] + u[5] * u[5] + DILATION
    determinant = a * c - b * b
    opacity = vload(opacities, i)
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
    vstore2(means2d, 2 * i, (select(seen, mx, zero), select(seen, my, zero)))
    vstore3(
        conics,
        3 * i,
        (
            select(seen, conic_a, zero),
            select(seen, conic_b, zero),
            select(seen, conic_c, zero),
        ),
    )
    radius = vmin(-vfloor(-vmax(hx, hy)), 1e9)
    vstore(spans, 0, select(seen, vmax(radius, 1.0), zero))
    if mask_bits(seen) == 0:
        return 0, 0, 0, 0
    A, B, C = -0.5 * LOG2_E * conic_a, -LOG2_E * conic_b, -0.5 * LOG2_E * conic_c
    y_per_x, x_per_y = b / a, b / c
    vstore8(records, RECORD * i, (mx, my, A, B, C, level, y_per_x, x_per_y))

    # Pixels whose centres lie in the ellipse's box, then their tiles; there may be no such pixel.
    left, top = -vfloor(-vmax(mx - hx - 0.5, 0.0)), -vfloor(-vmax(my - hy - 0.5, 0.0))
    right, bottom = (
        vfloor(vmin(mx + hx - 0.5, width - 1.0)),
        vfloor(vmin(my + hy - 0.5, height - 1.0)),
    )
    seen = seen & (left <= right) & (top <= bottom)
    x0, y0 = (
        vfloor(select(seen, left, zero) * 0.0625),
        vfloor(select(seen, top, zero) * 0.0625),
    )
    x1, y1 = (
        vfloor(select(seen, right, zero) * 0.0625),
        vfloor(select(seen, bottom, zero) * 0.0625),
    )
    vstore(spans, GROUP, x0)
    vstore(spans, 2 * GROUP, y0)
    vstore(spans, 3 * GROUP, x1)
    vstore(spans, 4 * GROUP, y1)
    left, top = x0 * 16.0 + 0.5 - mx, y0 * 16.0 + 0.5 - my
    floor = REACH - level
    near_x, near_y, far_x, far_y = left + 15.0, top + 15.0, left + 31.0, top + 31.0
    nn = nearest_exponent(left, top, near_x, near_y, A, B, C, y_per_x, x_per_y)
    fn = nearest_exponent(left + 16.0, top, far_x, near_y, A, B, C, y_per_x, x_per_y)
    nf = nearest_exponent(left, top + 16.0, near_x, far_y, A, B, C, y_per_x, x_per_y)
    ff = nearest_exponent(left + 16.0, top + 16.0, far_x, far_y, A, B, C, y_per_x, x_per_y)
    wide, tall = seen & (x1 > x0), seen & (y1 > y0)
    return (
        mask_bits(seen & (nn >= floor)),
        mask_bits(wide & (fn >= floor)),
        mask_bits(tall & (nf >= floor)),
        mask_bits(wide & tall & (ff >= floor)),
    )


@njit(nogil=True, cache=True)
def footprint(i, quats, scales, R, lens, width, height, x, y, z, iz):
    """U = J R R_q S of sixteen Gaussians (2 x 3), whose square is the 2D covariance.

    Returns:
        U by rows; the rotation R R_q by rows; (1/|q|, w, x, y, z normalised, x/z clamped, y/z clamped).
    """
    w, qx, qy, qz = vload4(quats, 4 * i)
    shrink = 1.0 / vmax(vsqrt(w * w + qx * qx + qy * qy + qz * qz), 1e-12)
    w, qx, qy, qz = w * shrink, qx * shrink, qy * shrink, qz * shrink
    V = matmul(R, rotation(w, qx, qy, qz))
    s0, s1, s2 = vload3(scales, 3 * i)
    limits = clamp_limits(lens, width, height)
    tx, ty = (
        vmin(vmax(x * iz, limits[0]), limits[1]),
        vmin(vmax(y * iz, limits[2]), limits[3]),
    )
    jx, jy = lens[0] * iz, lens[1] * iz
    u = (
        jx * (V[0] - tx * V[6]) * s0, jx * (V[1] - tx * V[7]) * s1, jx * (V[2] - tx * V[8]) * s2,
        jy * (V[3] - ty * V[6]) * s0, jy * (V[4] - ty * V[7]) * s1, jy * (V[5] - ty * V[8]) * s2,
    )  # fmt: skip
    return u, V, (shrink, w, qx, qy, qz, tx, ty)


@njit(nogil=True, cache=True)
def project_backward(
    counter, means, quats, scales, view, lens, width, height, radii,
    v_means2d, v_depths, v_conics, v_means, v_quats, v_scales,
):  # fmt: skip
    """Gradients of means, quaternions and scales from those of centres, depths and conics."""
    n = radii.size
    groups = (n + GROUP - 1) // GROUP
    seen = np.empty(GROUP, np.float32)
    while True:
        first = fetch_add(counter, 1) * CHUNK
        if first >= groups:
            break
        for group in range(first, min(first + CHUNK, groups)):
            i = min(group * GROUP, n - GROUP)
            any_seen = False
            for lane in range(GROUP):
                seen[lane] = np.float32(radii[i + lane] > 0)
                any_seen |= radii[i + lane] > 0
            if any_seen:
                project_group_backward(
                    i, seen, means, quats, scales, view, lens, width, height,
                    v_means2d, v_depths, v_conics, v_means, v_quats, v_scales,
                )  # fmt: skip
            else:
                v_means[3 * i : 3 * (i + GROUP)] = 0.0
                v_quats[4 * i : 4 * (i + GROUP)] = 0.0
                v_scales[3 * i : 3 * (i + GROUP)] = 0.0


@njit(nogil=True, cache=True)
def project_group_backward(
    i, seen, means, quats, scales, view, lens, width, height,
    v_means2d, v_depths, v_conics, v_means, v_quats, v_scales,
):  # fmt: skip
    """The chain rule through `project_group` for sixteen Gaussians."""
    ok = vload(seen, 0) > 0.0
    R = camera_numbers(view)
    px, py, pz = vload3(means, 3 * i)
    x = R[0] * px + R[1] * py + R[2] * pz + view[3]
    y = R[3] * px + R[4] * py + R[5] * pz + view[7]
    z = select(ok, R[6] * px + R[7] * py + R[8] * pz + view[11], 1.0)
    iz = 1.0 / z
    u, V, rest = footprint(i, quats, scales, R, lens, width, height, x, y, z, iz)
    shrink, qw, qx, qy, qz, tx, ty = rest

    # conic = (c, -b, a) / (a c - b b). By way of the conics themselves a needle's small eigenvalue would be lost.
    a = u[0] * u[0] + u[1] * u[1] + u[2] * u[2] + DILATION
    b = u[0] * u[3] + u[1] * u[4] + u[2] * u[5]
    c = u[3] * u[3] + u[4] * u[4] + u[5] * u[5] + DILATION
    scale = 1.0 / select(ok, a * c - b * b, 1.0)
    ga, gb, gc = vload3(v_conics, 3 * i)
    v_mx, v_my = vload2(v_means2d, 2 * i)
    ga, gb, gc = ga * scale, gb * scale, gc * scale
    v_det = (gb * b - ga * c - gc * a) * scale
    v_a, v_b, v_c = gc + v_det * c, -gb - 2.0 * v_det * b, ga + v_det * a

    g = (
        2.0 * v_a * u[0] + v_b * u[3], 2.0 * v_a * u[1] + v_b * u[4], 2.0 * v_a * u[2] + v_b * u[5],
        2.0 * v_c * u[3] + v_b * u[0], 2.0 * v_c * u[4] + v_b * u[1], 2.0 * v_c * u[5] + v_b * u[2],
    )  # fmt: skip
    s0, s1, s2 = vload3(scales, 3 * i)
    jx, jy = lens[0] * iz, lens[1] * iz
    k0, k1, k2 = jx * g[0], jx * g[1], jx * g[2]
    l0, l1, l2 = jy * g[3], jy * g[4], jy * g[5]
    m0, m1, m2 = -(tx * k0 + ty * l0), -(tx * k1 + ty * l1), -(tx * k2 + ty * l2)
    v_s0, v_s1 = k0 * V[0] + l0 * V[3] + m0 * V[6], k1 * V[1] + l1 * V[4] + m1 * V[7]
    v_s2 = k2 * V[2] + l2 * V[5] + m2 * V[8]
    zero = splat(0.0)
    vstore3(
        v_scales,
        3 * i,
        (select(ok, v_s0, zero), select(ok, v_s1, zero), select(ok, v_s2, zero)),
    )

    # V = R R_q: gradient of R_q is R^T applied to the gradient of V.
    transposed = (R[0], R[3], R[6], R[1], R[4], R[7], R[2], R[5], R[8])
    Q = matmul(
        transposed,
        (
            k0 * s0,
            k1 * s1,
            k2 * s2,
            l0 * s0,
            l1 * s1,
            l2 * s2,
            m0 * s0,
            m1 * s1,
            m2 * s2,
        ),
    )
    v_w = 2.0 * (qx * (Q[7] - Q[5]) + qy * (Q[2] - Q[6]) + qz * (Q[3] - Q[1]))
    v_x = 2.0 * (-2.0 * qx * (Q[4] + Q[8]) + qy * (Q[1] + Q[3]) + qz * (Q[2] + Q[6]) + qw * (Q[7] - Q[5]))
    v_y = 2.0 * (qx * (Q[1] + Q[3]) - 2.0 * qy * (Q[0] + Q[8]) + qz * (Q[5] + Q[7]) + qw * (Q[2] - Q[6]))
    v_z = 2.0 * (qx * (Q[2] + Q[6]) + qy * (Q[5] + Q[7]) - 2.0 * qz * (Q[0] + Q[4]) + qw * (Q[3] - Q[1]))
    along = v_w * qw + v_x * qx + v_y * qy + v_z * qz
    shrink = select(ok, shrink, zero)
    v_w, v_x = (
        select(ok, v_w - along * qw, zero) * shrink,
        select(ok, v_x - along * qx, zero) * shrink,
    )
    v_y, v_z = (
        select(ok, v_y - along * qy, zero) * shrink,
        select(ok, v_z - along * qz, zero) * shrink,
    )
    vstore4(v_quats, 4 * i, (v_w, v_x, v_y, v_z))

    # Through the Jacobian: jx = fx/z, tx = clamp(x/z); a clamped tx does not move.
    w0, w1, w2 = V[0] - tx * V[6], V[1] - tx * V[7], V[2] - tx * V[8]
    y0, y1, y2 = V[3] - ty * V[6], V[4] - ty * V[7], V[5] - ty * V[8]
    v_jx = g[0] * w0 * s0 + g[1] * w1 * s1 + g[2] * w2 * s2
    v_jy = g[3] * y0 * s0 + g[4] * y1 * s1 + g[5] * y2 * s2
    v_tx = -(k0 * V[6] * s0 + k1 * V[7] * s1 + k2 * V[8] * s2)
    v_ty = -(l0 * V[6] * s0 + l1 * V[7] * s1 + l2 * V[8] * s2)
    limits = clamp_limits(lens, width, height)
    v_tx = select((x * iz >= limits[0]) & (x * iz <= limits[1]), v_tx, 0.0) + lens[0] * v_mx
    v_ty = select((y * iz >= limits[2]) & (y * iz <= limits[3]), v_ty, 0.0) + lens[1] * v_my
    v_cx, v_cy = v_tx * iz, v_ty * iz
    v_cz = vload(v_depths, i) - iz * (x * v_cx + y * v_cy + jx * v_jx + jy * v_jy)
    v_px, v_py = (
        R[0] * v_cx + R[3] * v_cy + R[6] * v_cz,
        R[1] * v_cx + R[4] * v_cy + R[7] * v_cz,
    )
    v_pz = R[2] * v_cx + R[5] * v_cy + R[8] * v_cz
    vstore3(
        v_means,
        3 * i,
        (select(ok, v_px, zero), select(ok, v_py, zero), select(ok, v_pz, zero)),
    )
