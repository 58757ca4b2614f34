"""Light transport for one photo, in Numba (``njit``): sun with cast shadows, sky and one bounce, lamps."""

import numpy as np
from numba import njit, prange

from demo_generator.material_kernels import LAMP, LEAVES, METAL, PAVING, albedo
from demo_generator.sky_kernels import HORIZON, LAMPS, SUN, SUN_COLOR, hash3, noise, sky
from demo_generator.tracer_kernels import (
    FAR,
    STACK,
    is_blocked,
    jit,
    local_normal,
    nearest_hit,
    to_local,
)

HAZE = 520.0  # metres over which air hides 63 % of what lies behind it
LAMP_COLOR = (1.0, 0.6, 0.24)
EPSILON = 2e-3


@jit
def first_hit(place, visitors, ox, oy, oz, dx, dy, dz, start, stack):
    """First hit of a ray: distance, index, and whether it is a visitor (1) or the static scene (0)."""
    t, i = nearest_hit(place, ox, oy, oz, dx, dy, dz, start, FAR, stack)
    s, j = nearest_hit(visitors, ox, oy, oz, dx, dy, dz, start, t, stack)
    if j >= 0:
        return s, j, 1
    return t, i, 0


@jit
def in_shadow(place, visitors, ox, oy, oz, dx, dy, dz, limit, stack):
    """Whether anything stands between a point and a light."""
    if is_blocked(place, ox, oy, oz, dx, dy, dz, limit, stack):
        return True
    return is_blocked(visitors, ox, oy, oz, dx, dy, dz, limit, stack)


@jit
def surface(world, i, px, py, pz, dx, dy, dz, blur):
    """World normal (towards the ray's start), colour, emission, mirror share and material at a point."""
    kind, pose, size, material, color, _, _, _ = world
    rows = pose[i]
    x, y, z = to_local(rows, px - rows[9], py - rows[10], pz - rows[11])
    lx, ly, lz = local_normal(kind[i], size[i], x, y, z)
    nx = rows[0] * lx + rows[3] * ly + rows[6] * lz
    ny = rows[1] * lx + rows[4] * ly + rows[7] * lz
    nz = rows[2] * lx + rows[5] * ly + rows[8] * lz
    if nx * dx + ny * dy + nz * dz > 0.0:
        nx, ny, nz, lx, ly, lz = -nx, -ny, -nz, -lx, -ly, -lz
    r, g, b, glow, mirror = albedo(material[i], size[i], color[i], x, y, z, lx, ly, lz, px, py, pz, blur)
    return nx, ny, nz, r, g, b, glow, mirror, material[i]


@jit
def around(nx, ny, nz, u, v):
    """A direction of the cosine-weighted hemisphere about a normal."""
    z = 1.0 - 2.0 * u
    r = np.sqrt(max(0.0, 1.0 - z * z))
    x, y, z = nx + 0.999 * r * np.cos(6.2831853 * v), ny + 0.999 * r * np.sin(6.2831853 * v), nz + 0.999 * z
    n = 1.0 / np.sqrt(x * x + y * y + z * z)
    return x * n, y * n, z * n


@jit
def sunlight(place, visitors, light, px, py, pz, nx, ny, nz, u, v, stack):
    """Cosine times visibility of the sun; (u, v) picks a point of its disc."""
    if light[SUN_COLOR] <= 0.0:
        return 0.0
    spread = 0.012
    dx = light[SUN] + spread * (u - 0.5)
    dy = light[SUN + 1] + spread * (v - 0.5)
    dz = light[SUN + 2]
    cosine = nx * dx + ny * dy + nz * dz
    if cosine <= 0.0 or in_shadow(place, visitors, px, py, pz, dx, dy, dz, FAR, stack):
        return 0.0
    return cosine


@jit
def lamplight(place, visitors, light, lamps, px, py, pz, nx, ny, nz, stack):
    """Cosine over squared distance of the evening lamps that reach a point."""
    total = 0.0
    if light[LAMPS] <= 0.0:
        return total
    for k in range(lamps.shape[0]):
        dx, dy, dz = lamps[k, 0] - px, lamps[k, 1] - py, lamps[k, 2] - pz
        square = dx * dx + dy * dy + dz * dz
        length = np.sqrt(square)
        cosine = (nx * dx + ny * dy + nz * dz) / length
        gain = lamps[k, 3] * light[LAMPS] * cosine / (square + 1.0)
        if gain > 2e-3 and not in_shadow(
            place, visitors, px, py, pz, dx / length, dy / length, dz / length, length - 0.35, stack
        ):
            total += gain
    return total


@jit
def bounce(place, visitors, light, px, py, pz, dx, dy, dz, u, v, stack):
    """Radiance that arrives from a direction: the sky, or a surface lit by sun and (roughly) by sky."""
    t, i, who = first_hit(place, visitors, px, py, pz, dx, dy, dz, 1e-4, stack)
    if i < 0:
        return sky(light, dx, dy, dz, False)
    qx, qy, qz = px + t * dx, py + t * dy, pz + t * dz
    world = visitors if who == 1 else place
    nx, ny, nz, r, g, b, glow, _, _ = surface(world, i, qx, qy, qz, dx, dy, dz, 1.0)
    qx, qy, qz = qx + EPSILON * nx, qy + EPSILON * ny, qz + EPSILON * nz
    sun = sunlight(place, visitors, light, qx, qy, qz, nx, ny, nz, u, v, stack)
    fill = 0.22 + 0.28 * max(nz, 0.0)
    warm = glow * light[LAMPS] * 0.25
    return (
        r * (sun * light[SUN_COLOR] + fill * light[HORIZON]) + warm * LAMP_COLOR[0],
        g * (sun * light[SUN_COLOR + 1] + fill * light[HORIZON + 1]) + warm * LAMP_COLOR[1],
        b * (sun * light[SUN_COLOR + 2] + fill * light[HORIZON + 2]) + warm * LAMP_COLOR[2],
    )


@jit
def ruffle(kind, x, y, z, nx, ny, nz):
    """The normal of a rough surface."""
    amount, scale = (1.1, 5.0) if kind == LEAVES else ((0.05, 2.0) if kind == PAVING else (0.0, 1.0))
    if amount == 0.0:
        return nx, ny, nz
    nx += amount * (noise(x * scale, y * scale, z * scale) - 0.5) * 2.0
    ny += amount * (noise(x * scale + 31.0, y * scale, z * scale) - 0.5) * 2.0
    nz += amount * (noise(x * scale, y * scale + 57.0, z * scale) - 0.5) * 2.0
    n = 1.0 / np.sqrt(nx * nx + ny * ny + nz * nz)
    return nx * n, ny * n, nz * n


@jit
def shade_sample(place, visitors, light, lamps, origin, dx, dy, dz, spread, seed, x, y, out, stack):
    """Fills one sample of the buffers.

    `out`: 0-2 light from the sky and one bounce, 3-5 colour, 6-8 other light, 9-11 normal, 12 distance
    (0 = sky), 13 whether a visitor, 14 whether 0-2 are known: every other sample, as on a chessboard; the
    filter fills in the rest.
    """
    ox, oy, oz = origin[0], origin[1], origin[2]
    t, i, who = first_hit(place, visitors, ox, oy, oz, dx, dy, dz, 1e-3, stack)
    if i < 0:
        out[6], out[7], out[8] = sky(light, dx, dy, dz, True)
        return
    px, py, pz = ox + t * dx, oy + t * dy, oz + t * dz
    world = visitors if who == 1 else place
    nx, ny, nz, r, g, b, glow, mirror, kind = surface(world, i, px, py, pz, dx, dy, dz, t * spread)
    out[3], out[4], out[5] = r * (1.0 - mirror), g * (1.0 - mirror), b * (1.0 - mirror)
    out[9], out[10], out[11], out[12], out[13] = nx, ny, nz, t, who
    px, py, pz = px + EPSILON * nx, py + EPSILON * ny, pz + EPSILON * nz
    a, c = hash3(seed, x, 4 * y + 2), hash3(seed, x, 4 * y + 3)
    if (x + y) % 2 == 0:
        ax, ay, az = around(nx, ny, nz, hash3(seed, x, 4 * y), hash3(seed, x, 4 * y + 1))
        out[0], out[1], out[2] = bounce(place, visitors, light, px, py, pz, ax, ay, az, a, c, stack)
        out[14] = 1.0
    mx, my, mz = ruffle(kind, px, py, pz, nx, ny, nz)
    sun = sunlight(place, visitors, light, px, py, pz, mx, my, mz, a, c, stack)
    warm = lamplight(place, visitors, light, lamps, px, py, pz, mx, my, mz, stack)
    er, eg, eb = 0.0, 0.0, 0.0
    if mirror > 0.0:
        k = 2.0 * (dx * nx + dy * ny + dz * nz)
        rx, ry, rz = dx - k * nx, dy - k * ny, dz - k * nz
        er, eg, eb = bounce(place, visitors, light, px, py, pz, rx, ry, rz, a, c, stack)
        er, eg, eb = er * mirror, eg * mirror, eb * mirror
        if kind == METAL:
            er, eg, eb = er * (0.4 + r), eg * (0.4 + g), eb * (0.4 + b)
    glow *= light[LAMPS]
    if kind == LAMP:
        glow += 0.25
    out[6] = out[3] * (sun * light[SUN_COLOR] + warm * LAMP_COLOR[0]) + er + glow * LAMP_COLOR[0]
    out[7] = out[4] * (sun * light[SUN_COLOR + 1] + warm * LAMP_COLOR[1]) + eg + glow * LAMP_COLOR[1]
    out[8] = out[5] * (sun * light[SUN_COLOR + 2] + warm * LAMP_COLOR[2]) + eb + glow * LAMP_COLOR[2]


@njit(cache=True, parallel=True, fastmath={"contract", "arcp", "nsz"}, error_model="numpy")
def render_samples(
    place, visitors, light, lamps, origin, to_world, focal, center, width, height, per_pixel, seed
):
    """Buffers of `shade_sample` on a grid of per_pixel x per_pixel samples a pixel."""
    rows, columns = height * per_pixel, width * per_pixel
    buffers = np.zeros((rows, columns, 15), dtype=np.float32)
    for y in prange(rows):
        stack = np.empty(STACK, dtype=np.int64)
        for x in range(columns):
            cx = ((x + 0.5) / per_pixel - center[0]) / focal
            cy = ((y + 0.5) / per_pixel - center[1]) / focal
            n = 1.0 / np.sqrt(cx * cx + cy * cy + 1.0)
            dx = (to_world[0, 0] * cx + to_world[0, 1] * cy + to_world[0, 2]) * n
            dy = (to_world[1, 0] * cx + to_world[1, 1] * cy + to_world[1, 2]) * n
            dz = (to_world[2, 0] * cx + to_world[2, 1] * cy + to_world[2, 2]) * n
            shade_sample(
                place,
                visitors,
                light,
                lamps,
                origin,
                dx,
                dy,
                dz,
                1.0 / (focal * n),
                seed,
                x,
                y,
                buffers[y, x],
                stack,
            )
    return buffers


@njit(cache=True, parallel=True, fastmath={"contract", "arcp", "nsz"}, error_model="numpy")
def depth_and_kind(place, visitors, origin, to_world, focal, center, width, height):
    """Depth along the camera's axis at the pixel centres (0 = sky), and the kind of surface.

    That is -1 for the sky, 0 for the place, 1 for a visitor.
    """
    depth = np.zeros((height, width))
    what = np.full((height, width), -1, dtype=np.int64)
    for y in prange(height):
        stack = np.empty(STACK, dtype=np.int64)
        for x in range(width):
            cx, cy = (x + 0.5 - center[0]) / focal, (y + 0.5 - center[1]) / focal
            dx = to_world[0, 0] * cx + to_world[0, 1] * cy + to_world[0, 2]
            dy = to_world[1, 0] * cx + to_world[1, 1] * cy + to_world[1, 2]
            dz = to_world[2, 0] * cx + to_world[2, 1] * cy + to_world[2, 2]
            t, i, who = first_hit(place, visitors, origin[0], origin[1], origin[2], dx, dy, dz, 1e-3, stack)
            if i >= 0:
                depth[y, x], what[y, x] = t, who
    return depth, what


@jit
def nearby_indirect(buffers, x, y):
    """Mean over known neighbours, for a sample without a known neighbour on its own surface."""
    r, g, b, total = 0.0, 0.0, 0.0, 1e-6
    for v in range(max(y - 1, 0), min(y + 2, buffers.shape[0])):
        for u in range(max(x - 1, 0), min(x + 2, buffers.shape[1])):
            there = buffers[v, u]
            r, g, b, total = (
                r + there[14] * there[0],
                g + there[14] * there[1],
                b + there[14] * there[2],
                total + there[14],
            )
    return r / total, g / total, b / total


@jit
def smoothed(buffers, x, y, spacing):
    """Light from sky and bounce at a sample, averaged over its neighbours on the same surface."""
    rows, columns = buffers.shape[0], buffers.shape[1]
    here = buffers[y, x]
    if here[12] <= 0.0:
        return 0.0, 0.0, 0.0
    r, g, b, total = 0.0, 0.0, 0.0, 0.0
    for j in range(-2, 3):
        v = y + j * spacing
        for i in range(-2, 3):
            u = x + i * spacing
            if v < 0 or v >= rows or u < 0 or u >= columns:
                continue
            there = buffers[v, u]
            alike = here[9] * there[9] + here[10] * there[10] + here[11] * there[11]
            if there[12] <= 0.0 or there[13] != here[13] or alike < 0.8:
                continue
            gap = (there[12] - here[12]) / (0.02 * here[12] * spacing)
            near = (0.375 if i == 0 else 0.5 / 2.0 ** abs(i)) * (0.375 if j == 0 else 0.5 / 2.0 ** abs(j))
            weight = there[14] * near * alike**12 / (1.0 + gap * gap)
            r, g, b, total = (
                r + weight * there[0],
                g + weight * there[1],
                b + weight * there[2],
                total + weight,
            )
    if total <= 0.0:
        return nearby_indirect(buffers, x, y)
    return r / total, g / total, b / total


@njit(cache=True, parallel=True, fastmath={"contract", "arcp", "nsz"}, error_model="numpy")
def smooth_indirect(buffers, spacing, result):
    """One pass of an edge-avoiding wavelet filter over the light from sky and bounce (buffers 0 to 2)."""
    for y in prange(buffers.shape[0]):
        for x in range(buffers.shape[1]):
            r, g, b = smoothed(buffers, x, y, spacing)
            result[y, x, 0], result[y, x, 1], result[y, x, 2] = r, g, b


@njit(cache=True)
def heights_below(place, points, height):
    """Height of the first surface below points (x, y) at the given height."""
    result = np.empty(points.shape[0])
    stack = np.empty(STACK, dtype=np.int64)
    for k in range(points.shape[0]):
        t, _ = nearest_hit(place, points[k, 0], points[k, 1], height, 0.0, 0.0, -1.0, 1e-6, FAR, stack)
        result[k] = height - t
    return result
