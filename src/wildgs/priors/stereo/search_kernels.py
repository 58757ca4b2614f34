"""Numba (njit) kernels of PatchMatch stereo: the search for each pixel's plane (see `cost_kernels`).

Pixels are updated in a red-black pattern: those of one colour read only those of the other, so results do not
depend on the number of threads.
"""

from __future__ import annotations

import numpy as np

from wildgs.kernel_cache import njit
from wildgs.priors.stereo.cost_kernels import BLANK, SAMPLES, WORST, plane_cost, read_window
from wildgs.threads import fetch_add

BAND = 8
"""Rows of a work item."""
_MATHS = {"reassoc", "contract", "arcp", "nsz", "afn"}
_STEEPEST = np.float32(0.03)
"""Minimum cosine between a plane's normal and the viewing ray."""
_FAR_STRIP = 11


@njit(nogil=True, inline="always")
def _random(state):
    """Next random number of a pixel in [0, 1), and the new state (xorshift)."""
    state ^= (state << np.uint32(13)) & np.uint32(0xFFFFFFFF)
    state ^= state >> np.uint32(17)
    state ^= (state << np.uint32(5)) & np.uint32(0xFFFFFFFF)
    return np.float32(state >> np.uint32(8)) * np.float32(1 / 16777216), state


@njit(nogil=True, inline="always")
def _seeded(seed, y, x):
    state = np.uint32(seed * 0x9E3779B1 + y * 0x85EBCA77 + x * 0xC2B2AE3D) | np.uint32(1)
    for _ in range(3):
        _, state = _random(state)
    return state


@njit(nogil=True, inline="always")
def _tilted(q, x, y, intrinsics, nx, ny, nz):
    """Slope (q_x, q_y) of the plane with a normal in the camera's frame, and the cosine of its viewing angle."""
    rx = (np.float32(x) + np.float32(0.5) - intrinsics[2]) / intrinsics[0]
    ry = (np.float32(y) + np.float32(0.5) - intrinsics[3]) / intrinsics[1]
    along = nx * rx + ny * ry + nz
    cosine = abs(along) / np.sqrt(rx * rx + ry * ry + np.float32(1.0))
    if cosine < _STEEPEST:
        return np.float32(0.0), np.float32(0.0), cosine
    return q * nx / (intrinsics[0] * along), q * ny / (intrinsics[1] * along), cosine


@njit(nogil=True, inline="always")
def _too_steep(q, qx, qy, x, y, intrinsics):
    """Whether the viewing angle of a plane is too grazing for windows to match."""
    nx, ny = qx * intrinsics[0], qy * intrinsics[1]
    rx = (np.float32(x) + np.float32(0.5) - intrinsics[2]) / intrinsics[0]
    ry = (np.float32(y) + np.float32(0.5) - intrinsics[3]) / intrinsics[1]
    nz = q - nx * rx - ny * ry
    return q * q < _STEEPEST * _STEEPEST * (nx * nx + ny * ny + nz * nz) * (rx * rx + ry * ry + 1)


@njit(nogil=True, error_model="numpy")
def _random_normal(state):
    """A random direction in the hemisphere that faces the camera."""
    a, state = _random(state)
    b, state = _random(state)
    nz = np.float32(0.3) + np.float32(0.7) * a
    radius = np.sqrt(max(np.float32(0.0), np.float32(1.0) - nz * nz))
    angle = np.float32(2 * np.pi) * b
    return radius * np.cos(angle), radius * np.sin(angle), nz, state


@njit(nogil=True, fastmath=_MATHS, error_model="numpy")
def first_planes(counter, compared, intrinsics, bounds, up, guesses, draws, seed, offsets, planes, costs):
    """Initialises each pixel with the best of its guesses (inverse depths of nearby points) and random planes.

    `bounds` are the minimum and maximum inverse depth, `up` is the world's up direction in the camera's frame. Each
    guess is tried as a fronto-parallel and as a level plane. Textureless windows keep the first guess at the worst
    cost.
    """
    place = compared[2][compared[3]]
    width, height = place[1], place[2]
    window = (offsets, np.empty(SAMPLES, np.float32), np.empty(SAMPLES, np.float32))
    found = np.empty(compared[4].size, np.float32)
    while True:
        y = fetch_add(counter, 1)
        if y >= height:
            break
        for x in range(width):
            state = _seeded(seed, y, x)
            variance = read_window(compared[0], place, x, y, window)
            planes[y, x, 0] = guesses[y, x, 0]
            planes[y, x, 1] = 0.0
            planes[y, x, 2] = 0.0
            costs[y, x] = WORST
            if variance < BLANK:
                continue
            number = guesses.shape[2]
            for k in range(2 * number + draws):
                if k < 2 * number:
                    q = guesses[y, x, k // 2]
                    qx, qy = np.float32(0.0), np.float32(0.0)
                    if k % 2:
                        qx, qy, cosine = _tilted(q, x, y, intrinsics, up[0], up[1], up[2])
                        if cosine < _STEEPEST:
                            continue
                else:
                    share, state = _random(state)
                    share = (np.float32(k - 2 * number) + share) / np.float32(draws)
                    q = bounds[0] + share * (bounds[1] - bounds[0])
                    nx, ny, nz, state = _random_normal(state)
                    qx, qy, cosine = _tilted(q, x, y, intrinsics, nx, ny, nz)
                cost = plane_cost(compared, x, y, q, qx, qy, window, variance, found)
                if cost < costs[y, x]:
                    costs[y, x] = cost
                    planes[y, x, 0], planes[y, x, 1], planes[y, x, 2] = q, qx, qy


@njit(nogil=True, inline="always")
def carried_plane(planes, y, x, j, i):
    """The plane of pixel (j, i), extrapolated to (y, x)."""
    qx, qy = planes[j, i, 1], planes[j, i, 2]
    return planes[j, i, 0] + qx * np.float32(x - i) + qy * np.float32(y - j), qx, qy


@njit(nogil=True, fastmath=_MATHS, error_model="numpy")
def improve_planes(
    counter, compared, intrinsics, bounds, colour, spread, seed, hints, offsets, planes, costs
):
    """Half an iteration: propagation from pixels of the other colour, then random refinement.

    In each of four directions, the adjacent plane and the best of a strip further out are tried. `spread` is the
    relative size of random perturbations of the inverse depth. `hints` are further candidate planes (see
    `carry_planes`), or empty.
    """
    place = compared[2][compared[3]]
    width, height = place[1], place[2]
    window = (offsets, np.empty(SAMPLES, np.float32), np.empty(SAMPLES, np.float32))
    found = np.empty(compared[4].size, np.float32)
    while True:
        band = fetch_add(counter, 1)
        if band * BAND >= height:
            break
        for y in range(band * BAND, min(height, (band + 1) * BAND)):
            for x in range((y + colour) % 2, width, 2):
                variance = read_window(compared[0], place, x, y, window)
                if variance < BLANK:
                    costs[y, x] = WORST
                    continue
                state = _seeded(seed, y, x)
                q, qx, qy, cost = planes[y, x, 0], planes[y, x, 1], planes[y, x, 2], costs[y, x]
                if cost == WORST:
                    cost = plane_cost(compared, x, y, q, qx, qy, window, variance, found)
                for k in range(13):
                    if k < 8:
                        sx = (k % 4 == 0) - (k % 4 == 1)
                        sy = (k % 4 == 2) - (k % 4 == 3)
                        i, j = x + sx, y + sy
                        if k >= 4:
                            i, j = x + 3 * sx, y + 3 * sy
                            for step in range(5, _FAR_STRIP + 1, 2):
                                a, b = x + step * sx, y + step * sy
                                if 0 <= a < width and 0 <= b < height and costs[b, a] < costs[j, i]:
                                    i, j = a, b
                        if i < 0 or j < 0 or i >= width or j >= height:
                            continue
                        tq, tx, ty = carried_plane(planes, y, x, j, i)
                        # Skips planes that are indistinguishable from the current one.
                        if (
                            abs(tq - q) < np.float32(3e-4) * q
                            and abs(tx - qx) + abs(ty - qy) < np.float32(1e-4) * q
                        ):
                            continue
                    elif k == 12:
                        if hints.size == 0 or hints[y, x, 0] <= 0:
                            continue
                        tq, tx, ty = hints[y, x, 0], hints[y, x, 1], hints[y, x, 2]
                    else:
                        a, state = _random(state)
                        tq, tx, ty = q, qx, qy
                        if k != 9:
                            tq = q * (np.float32(1.0) + spread * (np.float32(2.0) * a - np.float32(1.0)))
                        if k == 9 or k == 10:
                            b, state = _random(state)
                            c, state = _random(state)
                            tilt = np.float32(0.3) * spread * q
                            tx += tilt * (np.float32(2.0) * b - np.float32(1.0))
                            ty += tilt * (np.float32(2.0) * c - np.float32(1.0))
                        if k == 11:
                            nx, ny, nz, state = _random_normal(state)
                            tx, ty, _ = _tilted(tq, x, y, intrinsics, nx, ny, nz)
                    if tq < bounds[0] or tq > bounds[1] or _too_steep(tq, tx, ty, x, y, intrinsics):
                        continue
                    trial = plane_cost(compared, x, y, tq, tx, ty, window, variance, found)
                    if trial < cost:
                        q, qx, qy, cost = tq, tx, ty, trial
                planes[y, x, 0], planes[y, x, 1], planes[y, x, 2], costs[y, x] = q, qx, qy, cost
