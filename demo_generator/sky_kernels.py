"""Noise and the sky dome, in Numba (``njit``)."""

import numpy as np

from demo_generator.tracer_kernels import jit

# Entries of the light vector that `lighting.Light.vector` fills.
SUN, SUN_COLOR, ZENITH, HORIZON, GLOW, CLOUD_COLOR, CLOUDS, CLOUD_SEED, LAMPS = 0, 3, 6, 9, 12, 15, 18, 19, 20
LIGHT_SIZE = 21


@jit
def hash3(x, y, z):
    """A number in [0, 1) that depends on three integers."""
    h = (
        np.uint64(x) * np.uint64(0x9E3779B97F4A7C15)
        ^ np.uint64(y) * np.uint64(0xC2B2AE3D27D4EB4F)
        ^ np.uint64(z) * np.uint64(0x165667B19E3779F9)
    )
    h ^= h >> np.uint64(31)
    h *= np.uint64(0xBF58476D1CE4E5B9)
    h ^= h >> np.uint64(29)
    h *= np.uint64(0x94D049BB133111EB)
    h ^= h >> np.uint64(32)
    return np.float64(h >> np.uint64(11)) * (1.0 / 9007199254740992.0)


@jit
def noise(x, y, z):
    """Smooth value noise in [0, 1] with unit cells."""
    fx, fy, fz = np.floor(x), np.floor(y), np.floor(z)
    i, j, k = np.int64(fx), np.int64(fy), np.int64(fz)
    u, v, w = x - fx, y - fy, z - fz
    u, v, w = u * u * (3.0 - 2.0 * u), v * v * (3.0 - 2.0 * v), w * w * (3.0 - 2.0 * w)
    a = hash3(i, j, k) * (1.0 - u) + hash3(i + 1, j, k) * u
    b = hash3(i, j + 1, k) * (1.0 - u) + hash3(i + 1, j + 1, k) * u
    c = hash3(i, j, k + 1) * (1.0 - u) + hash3(i + 1, j, k + 1) * u
    d = hash3(i, j + 1, k + 1) * (1.0 - u) + hash3(i + 1, j + 1, k + 1) * u
    return (a * (1.0 - v) + b * v) * (1.0 - w) + (c * (1.0 - v) + d * v) * w


@jit
def fractal(x, y, z, octaves):
    """Sum of octaves of noise, in [0, 1]."""
    total, weight, norm = 0.0, 0.5, 0.0
    for _ in range(octaves):
        total += weight * noise(x, y, z)
        norm += weight
        x, y, z, weight = x * 2.03 + 17.1, y * 2.03 + 5.7, z * 2.03 + 9.2, weight * 0.5
    return total / norm


@jit
def step_between(low, high, x):
    """0 below low, 1 above high, smooth between."""
    t = min(max((x - low) / (high - low), 0.0), 1.0)
    return t * t * (3.0 - 2.0 * t)


@jit
def sky(light, dx, dy, dz, with_clouds):
    """Radiance of the sky in a direction (unit length), linear RGB."""
    height = max(dz, 0.0)
    k = (1.0 - height) ** 3.5
    toward = max(dx * light[SUN] + dy * light[SUN + 1] + dz * light[SUN + 2], 0.0)
    glow = 0.30 * toward**4 + 0.9 * toward**40 + 5.0 * toward**1200
    glow *= 0.35 + 0.65 * k
    r = light[ZENITH] * (1.0 - k) + light[HORIZON] * k + light[GLOW] * glow
    g = light[ZENITH + 1] * (1.0 - k) + light[HORIZON + 1] * k + light[GLOW + 1] * glow
    b = light[ZENITH + 2] * (1.0 - k) + light[HORIZON + 2] * k + light[GLOW + 2] * glow
    amount = light[CLOUDS]
    if with_clouds and amount > 0.0 and dz > 0.0:
        s = 2.1 / (dz + 0.16)
        x, y = dx * s + light[CLOUD_SEED] * 13.7, dy * s * 1.2 + light[CLOUD_SEED] * 7.3
        shape = fractal(x, y, light[CLOUD_SEED], 5)
        cover = step_between(0.74 - 0.42 * amount, 0.98 - 0.36 * amount, shape)
        cover *= step_between(0.02, 0.2, dz) * 0.88
        lit = 0.72 + 0.4 * fractal(x + 0.35 * light[SUN], y + 0.35 * light[SUN + 1], light[CLOUD_SEED], 3)
        r += cover * (light[CLOUD_COLOR] * lit - r)
        g += cover * (light[CLOUD_COLOR + 1] * lit - g)
        b += cover * (light[CLOUD_COLOR + 2] * lit - b)
    if dz < 0.0:
        dim = max(1.0 + 4.0 * dz, 0.45)
        r, g, b = r * dim, g * dim, b * dim
    return r, g, b
