"""Numba (njit) functions that the projection's forward and backward pass share, on sixteen Gaussians at a time."""

from __future__ import annotations

import numpy as np

from wildgs.kernel_cache import njit
from wildgs.rasterize.cpu.simd import vmax, vmin, vsqrt
from wildgs.rasterize.cpu.simd_memory import vload3, vload4

GROUP = 16
CHUNK = 32  # groups that a thread takes at once
MIN_ALPHA = 1.0 / 255.0
LOG2_E = 1.4426950408889634


@njit(nogil=True)
def rotation(w, x, y, z):
    """Rotation matrix (rows) of a unit quaternion."""
    return (
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
        2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x),
        2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y),
    )  # fmt: skip


@njit(nogil=True)
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


@njit(nogil=True)
def camera_numbers(view):
    """The world-to-camera rotation as a tuple, from the flat 3 x 4 matrix."""
    return (view[0], view[1], view[2], view[4], view[5], view[6], view[8], view[9], view[10])


@njit(nogil=True)
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


@njit(nogil=True)
def cross(u):
    """Cross product of the two rows of U. Its length is the root of the determinant of U U^T, also for needles."""
    return (u[1] * u[5] - u[2] * u[4], u[2] * u[3] - u[0] * u[5], u[0] * u[4] - u[1] * u[3])


@njit(nogil=True)
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
    tx, ty = (vmin(vmax(x * iz, limits[0]), limits[1]), vmin(vmax(y * iz, limits[2]), limits[3]))
    jx, jy = lens[0] * iz, lens[1] * iz
    u = (
        jx * (V[0] - tx * V[6]) * s0, jx * (V[1] - tx * V[7]) * s1, jx * (V[2] - tx * V[8]) * s2,
        jy * (V[3] - ty * V[6]) * s0, jy * (V[4] - ty * V[7]) * s1, jy * (V[5] - ty * V[8]) * s2,
    )  # fmt: skip
    return u, V, (shrink, w, qx, qy, qz, tx, ty)
