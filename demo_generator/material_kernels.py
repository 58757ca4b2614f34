"""Procedural textures: stone, brick, tiles, paving, leaves, windows and clothes, in Numba (``njit``).

All patterns are filtered by the pixel's footprint: what is finer than a pixel fades to its mean.
"""

import numpy as np

from demo_generator.sky_kernels import fractal, hash3, noise, step_between
from demo_generator.tracer_kernels import jit

(
    PLAIN,
    ASHLAR,
    BRICK,
    TILES,
    DOME,
    COLUMN,
    PAVING,
    LEAVES,
    HOUSE,
    GLASS,
    WATER,
    GRASS,
    METAL,
    CLOCK,
    FRIEZE,
) = range(15)
CLOTH, BUS, LAMP, WOOD, MARBLE, HILL = range(15, 21)


@jit
def blocks(u, v, width, height, joint, blur):
    """Running bond: how much joint a pixel sees, and a random number for the block."""
    row = np.floor(v / height)
    shifted = u / width + 0.5 * (row - 2.0 * np.floor(row * 0.5))
    column = np.floor(shifted)
    du = (0.5 - abs(shifted - column - 0.5)) * width
    dv = (0.5 - abs(v / height - row - 0.5)) * height
    reach = 0.5 * blur
    edge = 1.0 - step_between(joint - reach, joint + reach, min(du, dv))
    edge *= min(1.0, 2.0 * joint / max(blur, 1e-6)) if blur > 2.0 * joint else 1.0
    fade = 1.0 - step_between(0.4, 1.2, blur / height)
    return edge * fade, 0.5 + (hash3(np.int64(column), np.int64(row), 7) - 0.5) * fade


@jit
def face_coordinates(x, y, z, nx, ny, nz):
    """Coordinates in metres on the face of a block that looks along n."""
    if abs(nz) > 0.75:
        return x, y
    if abs(nx) > abs(ny):
        return y, z
    return x, z


@jit
def paving(x, y, blur, r, g, b):
    """The square: rings of setts about the fountain, crossed by pale bands."""
    radius = np.sqrt(x * x + y * y)
    angle = np.arctan2(y, x)
    ring = np.floor(radius / 1.15)
    across = 24.0 if ring < 8.0 else (48.0 if ring < 18.0 else 72.0)
    edge, tint = blocks(angle / (2.0 * np.pi) * across * 1.3, radius, 1.3, 1.15, 0.035, blur * 0.9)
    spoke = abs(angle * 8.0 / np.pi - np.floor(angle * 8.0 / np.pi + 0.5)) * np.pi / 8.0 * radius
    band = 1.0 - step_between(0.42 - 0.5 * blur, 0.42 + 0.5 * blur, spoke)
    third = ring - 4.0 * np.floor(ring / 4.0)
    if third == 1.0:
        r, g, b = r * 0.74, g * 0.58, b * 0.52
    elif third == 3.0:
        r, g, b = r * 0.62, g * 0.63, b * 0.68
    r, g, b = r + band * (0.60 - r), g + band * (0.57 - g), b + band * (0.52 - b)
    shade = (0.72 + 0.56 * tint) * (1.0 - 0.5 * edge)
    return r * shade, g * shade, b * shade


@jit
def facade(u, v, top, blur, seed, r, g, b):
    """A house front: rows of shuttered windows. Gives the colour and how much of it is lit glass."""
    column, row = np.floor(u / 2.3), np.floor((v - 0.6) / 3.0)
    x, y = abs(u / 2.3 - column - 0.5) * 2.3, v - 0.6 - row * 3.0
    soft = max(blur, 0.02)
    inside = step_between(-soft, soft, min(0.48 - x, min(y - 0.7, 2.3 - y)))
    shutter = step_between(-soft, soft, min(min(x - 0.48, 0.98 - x), min(y - 0.7, 2.3 - y)))
    if v > top - 0.8 or row < 0.0:
        inside, shutter = 0.0, 0.0
    bar = 1.0 - 0.5 * step_between(0.0, 0.05, 0.06 - x)
    tone = 0.10 + 0.06 * hash3(np.int64(column), np.int64(row), np.int64(seed))
    r, g, b = r + inside * (tone * bar - r), g + inside * (tone * bar - g), b + inside * (1.3 * tone - b)
    r, g, b = r + shutter * (0.16 - r), g + shutter * (0.27 - g), b + shutter * (0.22 - b)
    lit = inside * (1.0 if hash3(np.int64(column), np.int64(row), np.int64(seed) + 3) > 0.55 else 0.0)
    return r, g, b, lit


@jit
def clock(x, y, r, g, b):
    """A clock's face of unit radius; the hands show ten past ten."""
    radius = np.sqrt(x * x + y * y)
    angle = np.arctan2(y, x) * 6.0 / np.pi
    mark = abs(angle - np.floor(angle + 0.5))
    dark = radius > 0.92 or (0.7 < radius < 0.88 and mark < 0.16)
    for k in range(2):
        turn, reach = (2.618, 0.45) if k == 0 else (0.5236, 0.68)
        along = x * np.cos(turn) + y * np.sin(turn)
        dark = dark or (0.0 < along < reach and abs(y * np.cos(turn) - x * np.sin(turn)) < 0.06)
    if dark:
        return 0.05, 0.05, 0.09
    return r, g, b


@jit
def bus_side(x, y, z, size, nx, ny, r, g, b):
    """Coachwork: a band of windows, a pale stripe below."""
    u, half = (y, size[1]) if abs(nx) > abs(ny) else (x, size[0])
    if 0.5 * size[2] < z < 0.86 * size[2] and abs(u) < half - 0.15:
        pane = u / 1.25 - np.floor(u / 1.25)
        if 0.05 < pane < 0.95 or abs(ny) > abs(nx):
            return 0.05, 0.06, 0.08
    if 0.36 * size[2] < z < 0.43 * size[2]:
        return 0.82, 0.80, 0.76
    return r, g, b


@jit
def ornament(u, v, height, r, g, b):
    """A frieze: gold discs and bars on a blue ground between gold borders."""
    cell = u / 0.78 - np.floor(u / 0.78) - 0.5
    x, y = cell * 0.78, v - 0.5 * height
    disc = np.sqrt(x * x + y * y)
    gold = (
        v < 0.12 * height
        or v > 0.88 * height
        or 0.13 < disc < 0.23
        or disc < 0.07
        or abs(abs(x) - 0.36) < 0.035
    )
    if gold:
        return 0.80, 0.56, 0.17
    return r, g, b


@jit
def albedo(kind, size, base, x, y, z, nx, ny, nz, wx, wy, wz, blur):
    """Colour (r, g, b), emission under evening light and mirror-like share at a point of a solid.

    The point is given in own coordinates (x, y, z) with its own normal and in the world's (wx, wy, wz);
    `size` and `base` are the solid's size and colour, `blur` is the width of a pixel there in metres.
    """
    r, g, b = base[0], base[1], base[2]
    glow, mirror = 0.0, 0.0
    stain = 1.0
    if kind == PLAIN:
        stain = 0.9 + 0.2 * noise(wx * 2.0, wy * 2.0, wz * 2.0)
    elif kind in (ASHLAR, MARBLE, BRICK):
        u, v = face_coordinates(x, y, z, nx, ny, nz)
        width, height, joint = (1.25, 0.5, 0.025) if kind == ASHLAR else (1.9, 0.62, 0.012)
        if kind == BRICK:
            width, height, joint = 0.56, 0.2, 0.022
        edge, tint = blocks(u, v, width, height, joint, blur)
        if kind == ASHLAR and abs(nz) < 0.75:
            row = np.floor(v / height)
            if row - 4.0 * np.floor(row * 0.25) == 2.0:
                r, g, b = r * 0.93, g * 0.66, b * 0.56
        spread = 0.34 if kind == ASHLAR else (0.6 if kind == BRICK else 0.16)
        shade = 1.0 + spread * (tint - 0.5)
        r, g, b = r * shade, g * (shade + 0.04 * (tint - 0.5)), b * (shade - 0.04 * (tint - 0.5))
        r, g, b = r + edge * (0.30 - r) * 0.75, g + edge * (0.27 - g) * 0.75, b + edge * (0.23 - b) * 0.75
        streak = fractal(wx * 1.1, wy * 1.1, wz * 0.28, 4)
        stain = 0.72 + 0.5 * streak
        stain *= 0.93 + 0.14 * noise(wx * 7.0, wy * 7.0, wz * 7.0)
    elif kind == TILES:
        u = y if abs(nx) > abs(ny) else x
        slope = 1.0 / max(np.sqrt(1.0 - nz * nz), 0.2)
        edge, tint = blocks(u, z * slope, 0.42, 0.5, 0.03, blur)
        wave = np.cos(u * (2.0 * np.pi / 0.42)) * (1.0 - step_between(0.1, 0.4, blur))
        shade = (0.78 + 0.5 * tint) * (1.0 - 0.5 * edge) * (1.0 + 0.16 * wave)
        r, g, b = r * shade, g * shade * (0.9 + 0.2 * tint), b * shade
        stain = 0.72 + 0.5 * fractal(wx * 0.9, wy * 0.9, wz * 0.9, 3)
    elif kind == DOME:
        turn = np.arctan2(y, x) * 8.0 / np.pi
        rib = abs(turn - np.floor(turn + 0.5))
        level = z / 0.62 - np.floor(z / 0.62)
        panel = hash3(np.int64(np.floor(turn + 0.5)), np.int64(np.floor(z / 0.62)), 3)
        shade = 0.86 + 0.28 * panel
        if rib > 0.43:
            shade *= 1.28
        elif level < 0.08:
            shade *= 0.72
        rust = step_between(0.5, 0.75, fractal(wx * 1.3, wy * 1.3, wz * 0.45, 4))
        r, g, b = r * shade, g * shade, b * shade
        r, g, b = r + rust * (0.30 - r) * 0.5, g + rust * (0.33 - g) * 0.5, b + rust * (0.27 - b) * 0.5
        mirror = 0.04
    elif kind == COLUMN:
        around = np.arctan2(y, x) * 10.0 / np.pi
        flute = np.cos(2.0 * np.pi * around)
        shade = 1.0 + 0.16 * flute * (1.0 - step_between(0.05, 0.2, blur))
        drum = np.floor(wz / 1.17)
        joint = abs(wz / 1.17 - drum - 0.5) * 2.34
        if joint > 1.13:
            shade *= 0.72
        shade *= 0.92 + 0.16 * hash3(np.int64(drum), np.int64(np.floor(wx * 0.5)), 5)
        stain = 0.78 + 0.4 * fractal(wx * 1.4, wy * 1.4, wz * 0.35, 4)
        r, g, b = r * shade, g * shade, b * shade
    elif kind == PAVING:
        r, g, b = paving(x, y, blur, r, g, b)
        stain = 0.74 + 0.5 * fractal(wx * 0.55, wy * 0.55, 0.5, 4)
        stain *= 0.93 + 0.14 * noise(wx * 6.0, wy * 6.0, 0.5)
    elif kind == LEAVES:
        leaf = fractal(wx * 4.2, wy * 4.2, wz * 4.2, 3)
        stain = 0.25 + 1.9 * leaf * leaf
        r *= 0.8 + 0.5 * noise(wx * 0.9, wy * 0.9, wz * 0.9)
    elif kind in (GRASS, HILL):
        scale = 0.5 if kind == GRASS else 0.045
        patch = fractal(wx * scale, wy * scale, wz * scale, 5)
        stain = 0.45 + 1.1 * patch
        r *= 0.75 + 0.6 * fractal(wx * scale * 0.3, wy * scale * 0.3, 3.0, 2)
    elif kind == HOUSE:
        if abs(nz) < 0.5:
            u, v = face_coordinates(x, y, z, nx, ny, nz)
            r, g, b, glow = facade(u + 50.6, v, size[2], blur, base[0] * 1000.0, r, g, b)
        stain = 0.82 + 0.32 * fractal(wx * 0.8, wy * 0.8, wz * 0.3, 3)
    elif kind == GLASS:
        u, v = face_coordinates(x, y, z, nx, ny, nz)
        across, up = (
            abs(u / 0.42 - np.floor(u / 0.42 + 0.5)) * 0.42,
            abs(v / 0.6 - np.floor(v / 0.6 + 0.5)) * 0.6,
        )
        if min(across, up) < 0.035:
            r, g, b = 0.22, 0.19, 0.16
        else:
            mirror, glow = 0.32, 0.75
            pane = 0.75 + 0.5 * hash3(np.int64(np.floor(u / 0.42)), np.int64(np.floor(v / 0.6)), 2)
            r, g, b = r * pane, g * pane, b * pane
    elif kind == WATER:
        if x * x + y * y > (size[1] - 0.3) ** 2 or nz < 0.5:
            r, g, b = 0.66, 0.62, 0.55
            stain = 0.75 + 0.45 * fractal(wx * 2.0, wy * 2.0, wz * 2.0, 3)
        else:
            mirror = 0.35
            stain = 0.8 + 0.4 * fractal(wx * 2.5, wy * 2.5, 0.0, 3)
    elif kind == METAL:
        mirror = 0.35
    elif kind == CLOCK:
        if nz > 0.5:
            r, g, b = clock(x / size[1], y / size[1], r, g, b)
            glow = 0.35
    elif kind == FRIEZE:
        if abs(nz) < 0.5:
            u, v = face_coordinates(x, y, z, nx, ny, nz)
            r, g, b = ornament(u, v, size[2], r, g, b)
        stain = 0.82 + 0.32 * noise(wx * 3.0, wy * 3.0, wz * 3.0)
    elif kind == CLOTH:
        seed = np.int64(base[0] * 977.0 + base[1] * 391.0)
        if hash3(seed, 1, 1) > 0.72 and z / 0.14 - np.floor(z / 0.14) < 0.5:
            r, g, b = 0.78, 0.76, 0.72
        stain = 0.8 + 0.35 * noise(wx * 6.0, wy * 6.0, wz * 4.0)
    elif kind == BUS:
        r, g, b = bus_side(x, y, z, size, nx, ny, r, g, b)
        mirror = 0.12
    elif kind == LAMP:
        glow = 1.7
    elif kind == WOOD:
        u, v = face_coordinates(x, y, z, nx, ny, nz)
        plank = u / 0.3 - np.floor(u / 0.3)
        stain = 0.55 if plank < 0.1 else 0.75 + 0.5 * noise(u * 12.0, v * 1.2, np.floor(u / 0.3) * 3.1)
    return r * stain, g * stain, b * stain, glow, mirror
