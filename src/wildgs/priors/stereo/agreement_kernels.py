"""Numba (njit) kernels of multi-view stereo: exchange of planes between photos, and consistency checks.

Planes, motions and layouts are defined in `cost_kernels`.
"""

from __future__ import annotations

import numpy as np

from wildgs.kernel_cache import njit
from wildgs.priors.stereo.search_kernels import carried_plane
from wildgs.threads import fetch_add


@njit(nogil=True, error_model="numpy")
def carry_planes(planes, costs, motion, back, hints, hint_costs):
    """Transfers a neighbour's planes to a photo; of several planes for one pixel, that of the lowest cost is kept.

    A plane q(x) = p . x of one camera is M^-T p / (1 + v . M^-T p) in the other, and M^-T is the transpose of the
    motion `back`.
    """
    for y in range(costs.shape[0]):
        for x in range(costs.shape[1]):
            cost = costs[y, x]
            if cost >= np.float32(1.0):
                continue
            q, qx, qy = planes[y, x, 0], planes[y, x, 1], planes[y, x, 2]
            cx, cy = np.float32(x) + np.float32(0.5), np.float32(y) + np.float32(0.5)
            z = motion[6] * cx + motion[7] * cy + motion[8] + motion[11] * q
            if z <= np.float32(1e-6):
                continue
            u = (motion[0] * cx + motion[1] * cy + motion[2] + motion[9] * q) / z
            v = (motion[3] * cx + motion[4] * cy + motion[5] + motion[10] * q) / z
            if u < 0 or v < 0 or u >= hint_costs.shape[1] or v >= hint_costs.shape[0]:
                continue
            i, j = int(u), int(v)
            if cost >= hint_costs[j, i]:
                continue
            constant = q - qx * cx - qy * cy
            a = back[0] * qx + back[3] * qy + back[6] * constant
            b = back[1] * qx + back[4] * qy + back[7] * constant
            c = back[2] * qx + back[5] * qy + back[8] * constant
            scale = np.float32(1.0) + motion[9] * a + motion[10] * b + motion[11] * c
            if abs(scale) < np.float32(1e-6):
                continue
            hints[j, i, 0] = (
                a * (np.float32(i) + np.float32(0.5)) + b * (np.float32(j) + np.float32(0.5)) + c
            ) / scale
            hints[j, i, 1], hints[j, i, 2] = a / scale, b / scale
            hint_costs[j, i] = cost


@njit(nogil=True, error_model="numpy")
def count_agreeing(
    counter,
    photo,
    layout,
    neighbours,
    motions,
    returns,
    planes,
    costs,
    most_cost,
    tolerance,
    reach,
    inverse,
    agreeing,
):
    """Counts the neighbours whose depth is consistent with that of a photo, per pixel.

    `planes` [P, 3] and `costs` [P] contain all photos in the layout of the pixels. Each pixel is projected into the
    neighbour, and the neighbour's estimate there is projected back (`returns`): it must land within `reach` pixels
    and differ by at most `tolerance` of the depth. The mean inverse depth of the photo and the consistent
    neighbours is written to `inverse`.
    """
    offset, width, height = layout[photo]
    while True:
        y = fetch_add(counter, 1)
        if y >= height:
            break
        for x in range(width):
            at = offset + y * width + x
            agreeing[y, x] = 0
            q = planes[at, 0]
            inverse[y, x] = q
            if costs[at] > most_cost or q <= 0:
                continue
            cx, cy = np.float32(x) + np.float32(0.5), np.float32(y) + np.float32(0.5)
            total = np.float64(q)
            for s in range(neighbours.size):
                m, r = motions[s], returns[s]
                other, wide, high = layout[neighbours[s]]
                z = m[6] * cx + m[7] * cy + m[8] + m[11] * q
                if z <= 1e-6:
                    continue
                u = (m[0] * cx + m[1] * cy + m[2] + m[9] * q) / z
                v = (m[3] * cx + m[4] * cy + m[5] + m[10] * q) / z
                if u < 0 or v < 0 or u >= wide or v >= high:
                    continue
                i, j = int(u), int(v)
                there = other + j * wide + i
                if costs[there] > most_cost:
                    continue
                p = planes[there, 0] + planes[there, 1] * (u - i - 0.5) + planes[there, 2] * (v - j - 0.5)
                if p <= 0:
                    continue
                w = r[6] * u + r[7] * v + r[8] + r[11] * p
                if w <= 1e-6:
                    continue
                back = p / w  # inverse depth of the neighbour's point in this camera
                du = (r[0] * u + r[1] * v + r[2] + r[9] * p) / w - cx
                dv = (r[3] * u + r[4] * v + r[5] + r[10] * p) / w - cy
                if du * du + dv * dv < reach * reach and abs(back - q) < tolerance * q:
                    agreeing[y, x] += 1
                    total += back
            inverse[y, x] = total / (1 + agreeing[y, x])


@njit(nogil=True, error_model="numpy")
def drop_specks(counter, planes, kept, tolerance, least, result):
    """Removes speckles: keeps a pixel if its plane fits at least `least` kept pixels of its 7 x 7 window."""
    height, width = kept.shape
    while True:
        y = fetch_add(counter, 1)
        if y >= height:
            break
        for x in range(width):
            result[y, x] = False
            if not kept[y, x]:
                continue
            fitting = 0
            for j in range(max(0, y - 3), min(height, y + 4)):
                for i in range(max(0, x - 3), min(width, x + 4)):
                    q, _, _ = carried_plane(planes, j, i, y, x)
                    if kept[j, i] and abs(planes[j, i, 0] - q) < tolerance * q:
                        fitting += 1
            result[y, x] = fitting > least  # the pixel itself is counted too
