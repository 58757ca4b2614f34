"""Ray casting of convex solids through a bounding volume hierarchy, in Numba (``njit``).

A world is the tuple that ``solids.World.arrays`` gives: kind, pose, size, material, color, node boxes,
node links, order. Every solid but the arch is convex, so that a ray meets it in one interval; an arch is a
box without a convex opening.
"""

import numpy as np
from numba import njit

BOX, FRUSTUM, ELLIPSOID, GABLE, PYRAMID, ARCH = 0, 1, 2, 3, 4, 5
FAR = 1e9
STACK = 64

jit = njit(cache=True, fastmath={"contract", "arcp", "nsz"}, error_model="numpy")


@jit
def clip_slab(o, d, low, high, t0, t1):
    """The part of [t0, t1] in which low <= o + t d <= high."""
    inverse = 1.0 / (d if abs(d) > 1e-12 else 1e-12)
    a, b = (low - o) * inverse, (high - o) * inverse
    return max(t0, min(a, b)), min(t1, max(a, b))


@jit
def clip_below(o, d, limit, t0, t1):
    """The part of [t0, t1] in which o + t d <= limit."""
    if abs(d) < 1e-12:
        return (t0, t1) if o <= limit else (FAR, -FAR)
    t = (limit - o) / d
    return (t0, min(t1, t)) if d > 0.0 else (max(t0, t), t1)


@jit
def clip_quadric(a, b, c, rising, t0, t1):
    """The part of [t0, t1] in which a t^2 + 2 b t + c <= 0; of two halves, the later one if rising."""
    if abs(a) < 1e-12:
        a = 1e-12
    square = b * b - a * c
    if square < 0.0:
        return FAR, -FAR
    root = np.sqrt(square)
    low, high = (-b - root) / a, (-b + root) / a
    if a > 0.0:
        return max(t0, low), min(t1, high)
    return (max(t0, low), t1) if rising else (t0, min(t1, high))


@jit
def opening_interval(s, ox, oy, oz, dx, dy, dz):
    """Where a ray is inside an arch's opening: a rectangle with a half disc on it."""
    a0, a1 = clip_slab(ox, dx, -s[3], s[3], -FAR, FAR)
    a0, a1 = clip_slab(oz, dz, -FAR, s[4], a0, a1)
    z = oz - s[4]
    b0, b1 = clip_quadric(
        dx * dx + dz * dz, ox * dx + z * dz, ox * ox + z * z - s[3] * s[3], False, -FAR, FAR
    )
    if a0 > a1:
        return b0, b1
    if b0 > b1:
        return a0, a1
    return min(a0, b0), max(a1, b1)


@jit
def interval(kind, s, ox, oy, oz, dx, dy, dz):
    """Where a ray (in the solid's own frame) is inside the solid's convex hull; empty if start > end."""
    t0, t1 = -FAR, FAR
    if kind == BOX:
        t0, t1 = clip_slab(ox, dx, -s[0], s[0], t0, t1)
        t0, t1 = clip_slab(oy, dy, -s[1], s[1], t0, t1)
        t0, t1 = clip_slab(oz, dz, 0.0, s[2], t0, t1)
    elif kind == FRUSTUM:
        k = (s[1] - s[0]) / s[2]
        r = s[0] + k * oz
        t0, t1 = clip_slab(oz, dz, 0.0, s[2], t0, t1)
        a = dx * dx + dy * dy - k * k * dz * dz
        b = ox * dx + oy * dy - k * r * dz
        t0, t1 = clip_quadric(a, b, ox * ox + oy * oy - r * r, k * dz > 0.0, t0, t1)
    elif kind == ELLIPSOID:
        x, y, z, u, v, w = ox / s[0], oy / s[1], oz / s[2], dx / s[0], dy / s[1], dz / s[2]
        t0, t1 = clip_quadric(
            u * u + v * v + w * w, x * u + y * v + z * w, x * x + y * y + z * z - 1.0, False, t0, t1
        )
        t0, t1 = clip_below(-oz, -dz, -s[3], t0, t1)
    elif kind == GABLE:
        t0, t1 = clip_slab(oy, dy, -s[1], s[1], t0, t1)
        t0, t1 = clip_below(-oz, -dz, 0.0, t0, t1)
        full = s[0] * s[2]
        t0, t1 = clip_below(s[2] * ox + s[0] * oz, s[2] * dx + s[0] * dz, full, t0, t1)
        t0, t1 = clip_below(-s[2] * ox + s[0] * oz, -s[2] * dx + s[0] * dz, full, t0, t1)
    elif kind == PYRAMID:
        t0, t1 = clip_below(-oz, -dz, 0.0, t0, t1)
        z, w = oz / s[2], dz / s[2]
        t0, t1 = clip_below(ox / s[0] + z, dx / s[0] + w, 1.0, t0, t1)
        t0, t1 = clip_below(-ox / s[0] + z, -dx / s[0] + w, 1.0, t0, t1)
        t0, t1 = clip_below(oy / s[1] + z, dy / s[1] + w, 1.0, t0, t1)
        t0, t1 = clip_below(-oy / s[1] + z, -dy / s[1] + w, 1.0, t0, t1)
    else:
        t0, t1 = clip_slab(ox, dx, -s[0], s[0], t0, t1)
        t0, t1 = clip_slab(oy, dy, -s[1], s[1], t0, t1)
        t0, t1 = clip_slab(oz, dz, 0.0, s[2], t0, t1)
    return t0, t1


@jit
def to_local(pose, px, py, pz):
    """A direction in the solid's own frame."""
    return (
        pose[0] * px + pose[1] * py + pose[2] * pz,
        pose[3] * px + pose[4] * py + pose[5] * pz,
        pose[6] * px + pose[7] * py + pose[8] * pz,
    )


@jit
def hit_distance(kind, pose, size, ox, oy, oz, dx, dy, dz, nearest):
    """Distance to the first point of the solid in front of the ray's start; FAR if there is none."""
    lx, ly, lz = to_local(pose, ox - pose[9], oy - pose[10], oz - pose[11])
    ux, uy, uz = to_local(pose, dx, dy, dz)
    t0, t1 = interval(kind, size, lx, ly, lz, ux, uy, uz)
    if t0 > t1 or t1 <= nearest:
        return FAR
    if kind == ARCH:
        s0, s1 = opening_interval(size, lx, ly, lz, ux, uy, uz)
        if s0 < s1:
            if t0 > nearest and not (s0 < t0 < s1):
                return t0
            # What starts in the opening or in front of it meets the wall behind it.
            if max(t0, nearest) >= s0 and nearest < s1 < t1:
                return s1
            if t0 <= nearest < s0 < t1:
                return s0
            return FAR
    return t0 if t0 > nearest else t1


@jit
def local_normal(kind, s, x, y, z):
    """Unit outward normal of the solid's face nearest to a point on its surface (own frame)."""
    if kind == ELLIPSOID:
        if z - s[3] < 1e-6 * s[2]:
            return 0.0, 0.0, -1.0
        x, y, z = x / (s[0] * s[0]), y / (s[1] * s[1]), z / (s[2] * s[2])
        n = 1.0 / np.sqrt(x * x + y * y + z * z)
        return x * n, y * n, z * n
    if kind == FRUSTUM:
        k = (s[1] - s[0]) / s[2]
        r = np.sqrt(x * x + y * y)
        side = abs(r - s[0] - k * z)
        if z < side:
            return 0.0, 0.0, -1.0
        if s[2] - z < side:
            return 0.0, 0.0, 1.0
        n = 1.0 / (np.sqrt(1.0 + k * k) * max(r, 1e-9))
        return x * n, y * n, -k * r * n
    if kind == GABLE:
        length = 1.0 / np.sqrt(s[0] * s[0] + s[2] * s[2])
        slope = (s[0] * s[2] - s[2] * abs(x) - s[0] * z) * length
        end = s[1] - abs(y)
        if end < slope and end < z:
            return 0.0, np.sign(y), 0.0
        if z < slope:
            return 0.0, 0.0, -1.0
        return np.sign(x) * s[2] * length, 0.0, s[0] * length
    if kind == PYRAMID:
        if abs(x) / s[0] > abs(y) / s[1]:
            n = 1.0 / np.sqrt(s[0] * s[0] + s[2] * s[2])
            return np.sign(x) * s[2] * n, 0.0, s[0] * n
        n = 1.0 / np.sqrt(s[1] * s[1] + s[2] * s[2])
        return 0.0, np.sign(y) * s[2] * n, s[1] * n
    ex, ey, ez = s[0] - abs(x), s[1] - abs(y), min(z, s[2] - z)
    if kind == ARCH:
        round_part = np.sqrt(x * x + (z - s[4]) * (z - s[4]))
        inner = abs(abs(x) - s[3]) if z <= s[4] else abs(round_part - s[3])
        if inner < ex and inner < ey and inner < ez:
            if z <= s[4]:
                return -np.sign(x), 0.0, 0.0
            return -x / round_part, 0.0, -(z - s[4]) / round_part
    if ex < ey and ex < ez:
        return np.sign(x), 0.0, 0.0
    if ey < ez:
        return 0.0, np.sign(y), 0.0
    return 0.0, 0.0, (1.0 if z > s[2] * 0.5 else -1.0)


@jit
def meets_box(box, ox, oy, oz, ix, iy, iz, limit):
    """Whether a ray (inverse direction) enters a node's box before the limit."""
    a, b = (box[0] - ox) * ix, (box[3] - ox) * ix
    t0, t1 = min(a, b), max(a, b)
    a, b = (box[1] - oy) * iy, (box[4] - oy) * iy
    t0, t1 = max(t0, min(a, b)), min(t1, max(a, b))
    a, b = (box[2] - oz) * iz, (box[5] - oz) * iz
    t0, t1 = max(t0, min(a, b)), min(t1, max(a, b))
    return t1 >= max(t0, 0.0) and t0 < limit


@jit
def nearest_hit(world, ox, oy, oz, dx, dy, dz, start, limit, stack):
    """Distance to the nearest solid between start and limit, and its index; (limit, -1) if there is none."""
    kind, pose, size, _, _, boxes, links, order = world
    found = -1
    if links.shape[0] == 0:
        return limit, found
    ix = 1.0 / (dx if abs(dx) > 1e-12 else 1e-12)
    iy = 1.0 / (dy if abs(dy) > 1e-12 else 1e-12)
    iz = 1.0 / (dz if abs(dz) > 1e-12 else 1e-12)
    stack[0] = 0
    depth = 1
    while depth > 0:
        depth -= 1
        node = stack[depth]
        if not meets_box(boxes[node], ox, oy, oz, ix, iy, iz, limit):
            continue
        first, count, axis = links[node, 0], links[node, 1], links[node, 2]
        if count > 0:
            for k in range(first, first + count):
                i = order[k]
                t = hit_distance(kind[i], pose[i], size[i], ox, oy, oz, dx, dy, dz, start)
                if t < limit:
                    limit, found = t, i
        else:
            forward = dx if axis == 0 else (dy if axis == 1 else dz)
            near, far = (first, first + 1) if forward > 0.0 else (first + 1, first)
            stack[depth] = far
            stack[depth + 1] = near
            depth += 2
    return limit, found


@jit
def is_blocked(world, ox, oy, oz, dx, dy, dz, limit, stack):
    """Whether any solid lies on the ray before the limit."""
    kind, pose, size, _, _, boxes, links, order = world
    if links.shape[0] == 0:
        return False
    ix = 1.0 / (dx if abs(dx) > 1e-12 else 1e-12)
    iy = 1.0 / (dy if abs(dy) > 1e-12 else 1e-12)
    iz = 1.0 / (dz if abs(dz) > 1e-12 else 1e-12)
    stack[0] = 0
    depth = 1
    while depth > 0:
        depth -= 1
        node = stack[depth]
        if not meets_box(boxes[node], ox, oy, oz, ix, iy, iz, limit):
            continue
        first, count = links[node, 0], links[node, 1]
        if count > 0:
            for k in range(first, first + count):
                i = order[k]
                if hit_distance(kind[i], pose[i], size[i], ox, oy, oz, dx, dy, dz, 1e-4) < limit:
                    return True
        else:
            stack[depth] = first
            stack[depth + 1] = first + 1
            depth += 2
    return False
