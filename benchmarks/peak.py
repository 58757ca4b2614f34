"""Peak of the processor for what the kernels compute: multiply-adds and exponentials with nothing to wait for."""

from __future__ import annotations

import time

import numpy as np
from numba import njit

from wildgs.rasterize.cpu.simd import fma, splat, vexp2
from wildgs.rasterize.cpu.simd_memory import vstore
from wildgs.threads import fetch_add, launch, thread_count

EXPONENTIAL_FMAS = 12
"""Multiply-adds that an exponential is worth."""
PEAK_ROUNDS, PEAK_EXPONENTIALS, PEAK_FMAS = 20_000, 4, 56


@njit(nogil=True)  # no cache: scripts import this file under two names
def peak_kernel(counter, chunks, out):
    """Exponentials and multiply-adds in the blend's proportion with nothing to wait for."""
    while True:
        chunk = fetch_add(counter, 1)
        if chunk >= chunks:
            break
        a, b, c, d = splat(-0.1), splat(-0.2), splat(-0.3), splat(-0.4)
        e, f, g, h = splat(0.1), splat(0.2), splat(0.3), splat(0.4)
        for _ in range(PEAK_ROUNDS):
            for _ in range(PEAK_FMAS // 8):
                a, b, c, d = fma(a, 0.5, -0.1), fma(b, 0.5, -0.1), fma(c, 0.5, -0.1), fma(d, 0.5, -0.1)
                e, f, g, h = fma(e, 0.5, 0.1), fma(f, 0.5, 0.1), fma(g, 0.5, 0.1), fma(h, 0.5, 0.1)
            e, f, g, h = e + vexp2(a), f + vexp2(b), g + vexp2(c), h + vexp2(d)
        vstore(out, chunk * 16, a + b + c + d + e + f + g + h)


def peak_seconds_per_fma() -> float:
    """What a multiply-add of sixteen numbers takes on all threads at their best."""
    chunks = 4 * thread_count()
    out = np.empty(16 * chunks, np.float32)
    seconds = min(_timed(chunks, out) for _ in range(7))
    per_block = seconds / (chunks * PEAK_ROUNDS * PEAK_EXPONENTIALS)
    return per_block / (PEAK_FMAS / PEAK_EXPONENTIALS + EXPONENTIAL_FMAS)


def _timed(chunks: int, out: np.ndarray) -> float:
    started = time.perf_counter()
    launch(peak_kernel, chunks, out)
    return time.perf_counter() - started
