"""Numba (njit) kernels of view-dependent colour: spherical harmonics and their gradient.

The polynomials are those of `wildgs.geometry.spherical_harmonics`, which the tests hold them to.
"""

from __future__ import annotations

import math

import numpy as np

from wildgs.kernel_cache import njit
from wildgs.threads import fetch_add

CHUNK = 512
F = np.float32
C0 = F(0.28209479177387814)
C1 = F(0.4886025119029199)
C2 = (F(1.0925484305920792), F(0.31539156525252005), F(0.5462742152960396))
C3 = (
    F(0.5900435899266435),
    F(2.890611442640554),
    F(0.4570457994644658),
    F(0.3731763325901154),
    F(1.445305721320277),
)


@njit(nogil=True)
def basis(degree, x, y, z, out):
    """The (degree + 1)^2 basis values of a unit direction."""
    out[0] = C0
    if degree < 1:
        return
    out[1], out[2], out[3] = -C1 * y, C1 * z, -C1 * x
    if degree < 2:
        return
    xx, yy, zz = x * x, y * y, z * z
    out[4], out[5] = C2[0] * x * y, -C2[0] * y * z
    out[6] = C2[1] * (F(2.0) * zz - xx - yy)
    out[7], out[8] = -C2[0] * x * z, C2[2] * (xx - yy)
    if degree < 3:
        return
    out[9] = -C3[0] * y * (F(3.0) * xx - yy)
    out[10] = C3[1] * x * y * z
    out[11] = -C3[2] * y * (F(4.0) * zz - xx - yy)
    out[12] = C3[3] * z * (F(2.0) * zz - F(3.0) * xx - F(3.0) * yy)
    out[13] = -C3[2] * x * (F(4.0) * zz - xx - yy)
    out[14] = C3[4] * z * (xx - yy)
    out[15] = -C3[0] * x * (xx - F(3.0) * yy)


@njit(nogil=True)
def basis_gradient(degree, x, y, z, v):
    """Gradient of sum v_k basis_k with respect to the (not yet normalised) direction's x, y and z."""
    gx = gy = gz = F(0.0)
    if degree >= 1:
        gy -= C1 * v[1]
        gz += C1 * v[2]
        gx -= C1 * v[3]
    if degree >= 2:
        gx += C2[0] * (y * v[4] - z * v[7]) + F(2.0) * x * (C2[2] * v[8] - C2[1] * v[6])
        gy += C2[0] * (x * v[4] - z * v[5]) - F(2.0) * y * (C2[2] * v[8] + C2[1] * v[6])
        gz += -C2[0] * (y * v[5] + x * v[7]) + F(4.0) * C2[1] * z * v[6]
    if degree >= 3:
        xx, yy, zz = x * x, y * y, z * z
        gx += F(-6.0) * C3[0] * x * y * v[9] + C3[1] * y * z * v[10] + F(2.0) * C3[2] * x * y * v[11]
        gx += F(-6.0) * C3[3] * x * z * v[12] - C3[2] * (F(4.0) * zz - F(3.0) * xx - yy) * v[13]
        gx += F(2.0) * C3[4] * x * z * v[14] - F(3.0) * C3[0] * (xx - yy) * v[15]
        gy += F(-3.0) * C3[0] * (xx - yy) * v[9] + C3[1] * x * z * v[10]
        gy += -C3[2] * (F(4.0) * zz - xx - F(3.0) * yy) * v[11] - F(6.0) * C3[3] * y * z * v[12]
        gy += F(2.0) * C3[2] * x * y * v[13] - F(2.0) * C3[4] * y * z * v[14] + F(6.0) * C3[0] * x * y * v[15]
        gz += C3[1] * x * y * v[10] - F(8.0) * C3[2] * y * z * v[11]
        gz += F(3.0) * C3[3] * (F(2.0) * zz - xx - yy) * v[12] - F(8.0) * C3[2] * x * z * v[13]
        gz += C3[4] * (xx - yy) * v[14]
    return gx, gy, gz


@njit(nogil=True)
def shade_forward(counter, means, sh, bases, degree, eye, visible, floor, out):
    """Colours max(floor, SH(direction) + 0.5) of the visible Gaussians; 0 for the others."""
    n = visible.size
    used = (degree + 1) * (degree + 1)
    values = np.empty(16, np.float32)
    while True:
        first = fetch_add(counter, 1) * CHUNK
        if first >= n:
            break
        for g in range(first, min(first + CHUNK, n)):
            red = green = blue = max(floor, F(0.0))
            if visible[g]:
                x, y, z = (means[3 * g] - eye[0], means[3 * g + 1] - eye[1], means[3 * g + 2] - eye[2])
                shrink = F(1.0) / max(math.sqrt(x * x + y * y + z * z), F(1e-12))
                basis(degree, x * shrink, y * shrink, z * shrink, values)
                red = green = blue = F(0.5)
                at = g * bases * 3
                for k in range(used):
                    red += values[k] * sh[at + 3 * k]
                    green += values[k] * sh[at + 3 * k + 1]
                    blue += values[k] * sh[at + 3 * k + 2]
            out[3 * g], out[3 * g + 1], out[3 * g + 2] = (
                max(red, floor),
                max(green, floor),
                max(blue, floor),
            )


@njit(nogil=True)
def shade_backward(counter, means, sh, bases, degree, eye, visible, floor, out, v_out, v_sh, v_means):
    """Gradients of the coefficients and (if `v_means` is not None) of the means."""
    n = visible.size
    used = (degree + 1) * (degree + 1)
    values = np.empty(16, np.float32)
    pulls = np.empty(16, np.float32)
    while True:
        first = fetch_add(counter, 1) * CHUNK
        if first >= n:
            break
        for g in range(first, min(first + CHUNK, n)):
            at = g * bases * 3
            red = v_out[3 * g] if out[3 * g] > floor else F(0.0)
            green = v_out[3 * g + 1] if out[3 * g + 1] > floor else F(0.0)
            blue = v_out[3 * g + 2] if out[3 * g + 2] > floor else F(0.0)
            if not visible[g] or (red == 0.0 and green == 0.0 and blue == 0.0):
                for k in range(3 * bases):
                    v_sh[at + k] = 0.0
                if v_means is not None:
                    v_means[3 * g] = v_means[3 * g + 1] = v_means[3 * g + 2] = 0.0
                continue
            x, y, z = (means[3 * g] - eye[0], means[3 * g + 1] - eye[1], means[3 * g + 2] - eye[2])
            shrink = F(1.0) / max(math.sqrt(x * x + y * y + z * z), F(1e-12))
            x, y, z = x * shrink, y * shrink, z * shrink
            basis(degree, x, y, z, values)
            for k in range(used):
                v_sh[at + 3 * k] = values[k] * red
                v_sh[at + 3 * k + 1] = values[k] * green
                v_sh[at + 3 * k + 2] = values[k] * blue
            for k in range(3 * used, 3 * bases):
                v_sh[at + k] = 0.0
            if v_means is not None:
                for k in range(used):
                    pulls[k] = sh[at + 3 * k] * red + sh[at + 3 * k + 1] * green + sh[at + 3 * k + 2] * blue
                gx, gy, gz = basis_gradient(degree, x, y, z, pulls)
                along = gx * x + gy * y + gz * z
                v_means[3 * g] = (gx - along * x) * shrink
                v_means[3 * g + 1] = (gy - along * y) * shrink
                v_means[3 * g + 2] = (gz - along * z) * shrink
