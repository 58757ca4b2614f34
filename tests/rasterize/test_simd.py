"""The vector layer under the CPU kernels, against NumPy in float64."""

from __future__ import annotations

import numpy as np
import pytest
from numba.extending import intrinsic

from wildgs.kernel_cache import njit
from wildgs.rasterize.cpu import simd
from wildgs.rasterize.cpu.simd import (
    LANES,
    SUM_LANES,
    lane_sums,
    vexp2,
    vratio,
)
from wildgs.rasterize.cpu.simd_memory import byte_bits, copy4, copy8, vload, vspread, vstore


@intrinsic
def portable_exp2(typingctx, value):
    """`vexp2` as processors without AVX-512 compute it."""
    return value(value), lambda context, builder, sig, args: simd._shifted_exp2(builder, args[0])


@njit(nogil=True)
def each(x, y, powers, portable, ratios):
    for i in range(0, x.size, LANES):
        vstore(powers, i, vexp2(vload(x, i)))
        vstore(portable, i, portable_exp2(vload(x, i)))
        vstore(ratios, i, vratio(vload(y, i), 1.0 - vload(y, i)))


@njit(nogil=True)
def sums(x, out):
    a, b, c, d, e = vload(x, 0), vload(x, 16), vload(x, 32), vload(x, 48), vload(x, 64)
    f, g, h, i, j = vload(x, 80), vload(x, 96), vload(x, 112), vload(x, 128), vload(x, 144)
    vstore(out, 0, lane_sums((a, b, c, d, e, f, g, h, i, j)))
    vstore(out, 16, lane_sums((a, b, c, d, e, f, g, h, i, j, vload(x, 160), vload(x, 176))))


@njit(nogil=True)
def moves(numbers, masks, out):
    copy8(out, 1, numbers, 3)
    copy4(out, 9, numbers, 20)
    vstore(out, 16, vspread(numbers, 5))
    return byte_bits(masks, 2, 7), byte_bits(masks, 2, 0)


def test_exponentials_and_ratios_to_the_last_bits():
    x = np.concatenate([np.linspace(-125, 0, 99_991), [-0.5, -1.5, -2.5, -7.0, -0.0]]).astype(np.float32)
    x = np.resize(x, -(-len(x) // LANES) * LANES)
    y = np.linspace(0, 0.999, len(x)).astype(np.float32)
    powers, portable, ratios = np.empty_like(x), np.empty_like(x), np.empty_like(x)
    each(x, y, powers, portable, ratios)
    for result in (powers, portable):
        assert np.abs(result / np.exp2(x.astype(np.float64)) - 1).max() < 4e-6
    exact = y / (np.float32(1) - y).astype(np.float64)
    assert np.abs(ratios - exact).max() / exact.max() < 3e-7
    assert (np.abs(ratios - exact) <= 3e-7 * exact).all()


@pytest.mark.parametrize("count", [10, 12])
def test_sums_stand_in_their_lanes(count: int):
    x = np.random.default_rng(0).random(12 * LANES, np.float32)
    out = np.zeros(2 * LANES, np.float32)
    sums(x, out)
    found = out[:LANES] if count == 10 else out[LANES:]
    expected = x.reshape(12, LANES).sum(1, dtype=np.float64)[:count]
    assert np.allclose(found[list(SUM_LANES[:count])], expected, rtol=1e-6)


def test_moves_and_bits():
    numbers, out = np.arange(32, dtype=np.float32), np.zeros(32, np.float32)
    masks = np.array([0, 0, *(0x81, 0x80, 1, 0) * 16], np.uint8)
    upper, lower = moves(numbers, masks, out)
    assert (upper % 2**64, lower) == (0x3333333333333333, 0x5555555555555555)
    assert out.tolist() == [0, *range(3, 11), *range(20, 24), 0, 0, 0, *[5] * 16]
