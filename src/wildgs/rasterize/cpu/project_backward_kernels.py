"""Numba (njit) kernels of the projection's gradient, sixteen Gaussians at a time (see `project_kernels`)."""

from __future__ import annotations

import numpy as np

from wildgs.kernel_cache import njit
from wildgs.rasterize.cpu.footprint_kernels import (
    CHUNK,
    GROUP,
    camera_numbers,
    clamp_limits,
    cross,
    footprint,
    matmul,
)
from wildgs.rasterize.cpu.simd import select, splat, vmax, vsqrt
from wildgs.rasterize.cpu.simd_memory import vload, vload2, vload3, vstore3, vstore4
from wildgs.threads import fetch_add


@njit(nogil=True)
def project_backward(
    counter, means, quats, scales, view, lens, width, height, radii,
    v_means2d, v_depths, v_conics, v_compensations, v_means, v_quats, v_scales,
):  # fmt: skip
    """Gradients of means, quaternions and scales from those of centres, depths, conics and compensations."""
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
                    v_means2d, v_depths, v_conics, v_compensations, v_means, v_quats, v_scales,
                )  # fmt: skip
            else:
                v_means[3 * i : 3 * (i + GROUP)] = 0.0
                v_quats[4 * i : 4 * (i + GROUP)] = 0.0
                v_scales[3 * i : 3 * (i + GROUP)] = 0.0


@njit(nogil=True)
def project_group_backward(
    i, seen, means, quats, scales, view, lens, width, height,
    v_means2d, v_depths, v_conics, v_compensations, v_means, v_quats, v_scales,
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
    a = u[0] * u[0] + u[1] * u[1] + u[2] * u[2] + lens[4]
    b = u[0] * u[3] + u[1] * u[4] + u[2] * u[5]
    c = u[3] * u[3] + u[4] * u[4] + u[5] * u[5] + lens[4]
    scale = 1.0 / select(ok, a * c - b * b, 1.0)
    ga, gb, gc = vload3(v_conics, 3 * i)
    v_mx, v_my = vload2(v_means2d, 2 * i)
    ga, gb, gc = ga * scale, gb * scale, gc * scale
    v_det = (gb * b - ga * c - gc * a) * scale
    if lens[5] > 0.0:
        # compensation = |n| / sqrt(a c - b b), where n is the cross product of the rows of U.
        n0, n1, n2 = cross(u)
        length = vsqrt(n0 * n0 + n1 * n1 + n2 * n2)
        v_length = vload(v_compensations, i) * vsqrt(scale)
        v_det = v_det - 0.5 * v_length * length * scale
    v_a, v_b, v_c = gc + v_det * c, -gb - 2.0 * v_det * b, ga + v_det * a

    g = (
        2.0 * v_a * u[0] + v_b * u[3], 2.0 * v_a * u[1] + v_b * u[4], 2.0 * v_a * u[2] + v_b * u[5],
        2.0 * v_c * u[3] + v_b * u[0], 2.0 * v_c * u[4] + v_b * u[1], 2.0 * v_c * u[5] + v_b * u[2],
    )  # fmt: skip
    if lens[5] > 0.0:
        per_length = v_length / vmax(length, 1e-12)
        n0, n1, n2 = n0 * per_length, n1 * per_length, n2 * per_length
        g = (
            g[0] + u[4] * n2 - u[5] * n1, g[1] + u[5] * n0 - u[3] * n2, g[2] + u[3] * n1 - u[4] * n0,
            g[3] + n1 * u[2] - n2 * u[1], g[4] + n2 * u[0] - n0 * u[2], g[5] + n0 * u[1] - n1 * u[0],
        )  # fmt: skip
    s0, s1, s2 = vload3(scales, 3 * i)
    jx, jy = lens[0] * iz, lens[1] * iz
    k0, k1, k2 = jx * g[0], jx * g[1], jx * g[2]
    l0, l1, l2 = jy * g[3], jy * g[4], jy * g[5]
    m0, m1, m2 = -(tx * k0 + ty * l0), -(tx * k1 + ty * l1), -(tx * k2 + ty * l2)
    v_s0, v_s1 = k0 * V[0] + l0 * V[3] + m0 * V[6], k1 * V[1] + l1 * V[4] + m1 * V[7]
    v_s2 = k2 * V[2] + l2 * V[5] + m2 * V[8]
    zero = splat(0.0)
    vstore3(v_scales, 3 * i, (select(ok, v_s0, zero), select(ok, v_s1, zero), select(ok, v_s2, zero)))

    # V = R R_q: gradient of R_q is R^T applied to the gradient of V.
    transposed = (R[0], R[3], R[6], R[1], R[4], R[7], R[2], R[5], R[8])
    Q = matmul(transposed, (k0 * s0, k1 * s1, k2 * s2, l0 * s0, l1 * s1, l2 * s2, m0 * s0, m1 * s1, m2 * s2))
    v_w = 2.0 * (qx * (Q[7] - Q[5]) + qy * (Q[2] - Q[6]) + qz * (Q[3] - Q[1]))
    v_x = 2.0 * (-2.0 * qx * (Q[4] + Q[8]) + qy * (Q[1] + Q[3]) + qz * (Q[2] + Q[6]) + qw * (Q[7] - Q[5]))
    v_y = 2.0 * (qx * (Q[1] + Q[3]) - 2.0 * qy * (Q[0] + Q[8]) + qz * (Q[5] + Q[7]) + qw * (Q[2] - Q[6]))
    v_z = 2.0 * (qx * (Q[2] + Q[6]) + qy * (Q[5] + Q[7]) - 2.0 * qz * (Q[0] + Q[4]) + qw * (Q[3] - Q[1]))
    along = v_w * qw + v_x * qx + v_y * qy + v_z * qz
    shrink = select(ok, shrink, zero)
    v_w, v_x = (select(ok, v_w - along * qw, zero) * shrink, select(ok, v_x - along * qx, zero) * shrink)
    v_y, v_z = (select(ok, v_y - along * qy, zero) * shrink, select(ok, v_z - along * qz, zero) * shrink)
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
    v_px, v_py = (R[0] * v_cx + R[3] * v_cy + R[6] * v_cz, R[1] * v_cx + R[4] * v_cy + R[7] * v_cz)
    v_pz = R[2] * v_cx + R[5] * v_cy + R[8] * v_cz
    vstore3(v_means, 3 * i, (select(ok, v_px, zero), select(ok, v_py, zero), select(ok, v_pz, zero)))
