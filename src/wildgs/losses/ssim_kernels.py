"""Numba kernels of the structural similarity and its gradient.

An image is a matrix of H rows and L = W * C numbers (channels interleaved), so that one inner loop runs over all
channels of a row and the horizontal window steps by C. Threads take blocks of `BLOCK` rows and write results per
row, so that results do not depend on the number of threads.
"""

from __future__ import annotations

import numpy as np

from wildgs.kernel_cache import njit
from wildgs.threads import fetch_add

RADIUS = 5
BLOCK = 16
_MATHS = {"reassoc", "contract", "arcp", "nsz"}  # without nnan, so that NaN propagates


@njit(fastmath=_MATHS, error_model="numpy")
def _filter_row(padded, taps, channels, out):
    """Filters one row that has RADIUS * channels zeros on either side.

    With views, every index is the plain loop variable, which LLVM needs to vectorise the loop.
    """
    length = out.shape[0]
    a0, a1 = padded[0:length], padded[10 * channels : 10 * channels + length]
    b0, b1 = padded[channels : channels + length], padded[9 * channels : 9 * channels + length]
    c0, c1 = padded[2 * channels : 2 * channels + length], padded[8 * channels : 8 * channels + length]
    d0, d1 = padded[3 * channels : 3 * channels + length], padded[7 * channels : 7 * channels + length]
    e0, e1 = padded[4 * channels : 4 * channels + length], padded[6 * channels : 6 * channels + length]
    centre = padded[5 * channels : 5 * channels + length]
    wa, wb, wc, wd, we, w = taps[0], taps[1], taps[2], taps[3], taps[4], taps[5]
    for j in range(length):
        tails = wa * (a0[j] + a1[j]) + wb * (b0[j] + b1[j]) + wc * (c0[j] + c1[j])
        out[j] = tails + wd * (d0[j] + d1[j]) + we * (e0[j] + e1[j]) + w * centre[j]


@njit(nogil=True, fastmath=_MATHS, error_model="numpy")
def _forward_rows(first, last, x, y, taps, c1, c2, channels, derivatives, row_sums):
    """Rows of `ssim_forward`.

    With E the window's weighted mean, the derivatives of ssim with respect to E[x], E[y], E[x^2] (equal to E[y^2])
    and E[xy] are written to `derivatives` [4, H, L].
    """
    height, length = x.shape
    pad = RADIUS * channels
    for i in range(first, last):
        sums = np.zeros((5, length + 2 * pad), dtype=x.dtype)
        sx, sy = sums[0, pad : pad + length], sums[1, pad : pad + length]
        sxx, syy, sxy = sums[2, pad : pad + length], sums[3, pad : pad + length], sums[4, pad : pad + length]
        for k in range(max(0, RADIUS - i), min(2 * RADIUS + 1, height + RADIUS - i)):
            w, u, v = taps[k], x[i + k - RADIUS], y[i + k - RADIUS]
            for j in range(length):
                wu, wv = w * u[j], w * v[j]
                sx[j] += wu
                sy[j] += wv
                sxx[j] += wu * u[j]
                syy[j] += wv * v[j]
                sxy[j] += wu * v[j]
        means = np.empty((5, length), dtype=x.dtype)
        for k in range(5):
            _filter_row(sums[k], taps, channels, means[k])
        mx, my, mxx, myy, mxy = means[0], means[1], means[2], means[3], means[4]
        by_x, by_y = derivatives[0, i], derivatives[1, i]
        by_square, by_cross = derivatives[2, i], derivatives[3, i]
        total = x.dtype.type(0)
        for j in range(length):
            p, q = mx[j], my[j]
            a = 2 * p * q + c1
            b = 2 * (mxy[j] - p * q) + c2
            c = p * p + q * q + c1
            d = mxx[j] + myy[j] - p * p - q * q + c2
            inverse = 1 / (c * d)
            value = a * b * inverse
            total += value
            by_b, by_d = a * inverse, -value * c * inverse
            by_a, by_c = b * inverse - by_b, -value * d * inverse - by_d
            by_x[j] = 2 * (q * by_a + p * by_c)
            by_y[j] = 2 * (p * by_a + q * by_c)
            by_square[j] = by_d
            by_cross[j] = 2 * by_b
        row_sums[i] = total


@njit(nogil=True, fastmath=_MATHS, error_model="numpy")
def _backward_rows(first, last, x, y, taps, scale, channels, derivatives, grad_x, grad_y):
    """Rows of `ssim_backward`.

    The window is symmetric, so the filter with zero padding is self-adjoint.
    """
    height, length = x.shape
    pad = RADIUS * channels
    for i in range(first, last):
        sums = np.zeros((4, length + 2 * pad), dtype=x.dtype)
        s0, s1 = sums[0, pad : pad + length], sums[1, pad : pad + length]
        s2, s3 = sums[2, pad : pad + length], sums[3, pad : pad + length]
        for k in range(max(0, RADIUS - i), min(2 * RADIUS + 1, height + RADIUS - i)):
            r = i + k - RADIUS
            w = scale * taps[k]
            p0, p1, p2, p3 = derivatives[0, r], derivatives[1, r], derivatives[2, r], derivatives[3, r]
            for j in range(length):
                s0[j] += w * p0[j]
                s1[j] += w * p1[j]
                s2[j] += w * p2[j]
                s3[j] += w * p3[j]
        means = np.empty((4, length), dtype=x.dtype)
        for k in range(4):
            _filter_row(sums[k], taps, channels, means[k])
        m0, m1, m2, m3 = means[0], means[1], means[2], means[3]
        u, v, out_x, out_y = x[i], y[i], grad_x[i], grad_y[i]
        for j in range(length):
            out_x[j] = m0[j] + 2 * m2[j] * u[j] + m3[j] * v[j]
            out_y[j] = m1[j] + 2 * m2[j] * v[j] + m3[j] * u[j]


@njit(nogil=True, error_model="numpy")
def ssim_forward(counter, x, y, taps, c1, c2, channels, derivatives, row_sums):
    """Sums the SSIM map per row and stores its derivatives with respect to the window's moments."""
    while True:
        first = fetch_add(counter, 1) * BLOCK
        if first >= len(x):
            break
        last = min(first + BLOCK, len(x))
        _forward_rows(first, last, x, y, taps, c1, c2, channels, derivatives, row_sums)


@njit(nogil=True, error_model="numpy")
def ssim_backward(counter, x, y, taps, scale, channels, derivatives, grad_x, grad_y):
    """Gradients of scale * (sum of the SSIM map) with respect to both images, from the stored derivatives."""
    while True:
        first = fetch_add(counter, 1) * BLOCK
        if first >= len(x):
            break
        last = min(first + BLOCK, len(x))
        _backward_rows(first, last, x, y, taps, scale, channels, derivatives, grad_x, grad_y)


def blocks(height: int) -> int:
    """Number of blocks of rows."""
    return -(-height // BLOCK)
