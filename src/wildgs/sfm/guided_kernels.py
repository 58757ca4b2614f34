"""CPU kernel that compares descriptors near epipolar lines.

One feature in a hundred is near a line, so that comparing only these takes a tenth of the time of a product of all
descriptors. Threads take features; a thread's arrays of intermediate results are allocated once.
"""

from __future__ import annotations

import math

import numpy as np

from wildgs.kernel_cache import njit
from wildgs.threads import fetch_add

_MATHS = {"reassoc", "contract", "arcp", "nsz"}

_WORD = 8
"""Bytes of the mask of near features that are skipped at a time."""


@njit(nogil=True, fastmath=_MATHS, error_model="numpy")
def find_clear(
    counter, lines, limits, descriptors, rays, other_limits, others, pixels, same_place, largest, ratio, found
):
    """Finds the clearly best match of each feature among those of another photo near its epipolar line.

    Args:
        counter: Number of features that threads have taken.
        lines: Epipolar line of each feature, [F, 3].
        limits: Largest residual of a feature near it, [F].
        descriptors: Unit vectors, [F, D].
        rays: The other photo's features as x and y at z = 1, [2, G]; NaN is near no line.
        other_limits: Largest residual of each of these, [G].
        others: Their descriptors, [G, D].
        pixels: Their positions, [G, 2].
        same_place: Distance up to which two of them are at one place and no rivals, pixels.
        largest: Largest angle between descriptors of a match, radians.
        ratio: Largest angle of a match relative to that of the second best at another place.
        found: Row of the match, -1 for none, [F]; written.
    """
    count = len(other_limits)
    mask = np.zeros((count + _WORD - 1) // _WORD * _WORD, np.uint8)
    words = mask.view(np.uint64)
    near, likeness = np.empty(count, np.int64), np.empty(count, np.float32)
    across, up = rays[0], rays[1]
    while True:
        row = fetch_add(counter, 1)
        if row >= len(limits):
            break
        a, b, c, limit = lines[row, 0], lines[row, 1], lines[row, 2], limits[row]
        for other in range(count):  # vectorised
            mask[other] = abs(a * across[other] + b * up[other] + c) < min(limit, other_limits[other])
        candidates, best = 0, -1
        for word in range(len(words)):
            if words[word] == 0:
                continue
            for other in range(word * _WORD, word * _WORD + _WORD):
                if mask[other]:
                    near[candidates] = other
                    likeness[candidates] = _product(descriptors[row], others[other])
                    if best < 0 or likeness[candidates] > likeness[best]:
                        best = candidates
                    candidates += 1
        found[row] = -1
        if best < 0:
            continue
        winner, second = near[best], np.float32(0.0)
        for candidate in range(candidates):
            other = near[candidate]
            apart = math.hypot(pixels[other, 0] - pixels[winner, 0], pixels[other, 1] - pixels[winner, 1])
            if apart > same_place and likeness[candidate] > second:
                second = likeness[candidate]
        angle = math.acos(min(likeness[best], np.float32(1.0)))
        if angle < largest and angle < ratio * math.acos(min(second, np.float32(1.0))):
            found[row] = winner


@njit(nogil=True, fastmath=_MATHS, error_model="numpy")
def _product(first, second):
    total = np.float32(0.0)
    for k in range(len(first)):  # vectorised
        total += first[k] * second[k]
    return total
