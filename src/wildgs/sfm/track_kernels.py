"""CPU kernel that moves the observations of a point to where photos show the same as each other.

Adaptive least squares correlation (Gruen, South African Journal of Photogrammetry 14, 1985), by the inverse
compositional algorithm (Baker and Matthews, International Journal of Computer Vision 56, 2004): the template's
gradients are computed once, and an iteration only samples the photo. Patches have mean 0 and norm 1, since photos
differ in exposure and contrast. Affine parameters are drawn towards those that the cameras say: those of a small
patch are poorly determined, and its place with them.

Threads take points. A thread's arrays of intermediate results are allocated once. Arrays are copied, added and
filled element by element, because Numba takes seconds to compile NumPy's expressions.
"""

from __future__ import annotations

import numpy as np

from wildgs.kernel_cache import njit
from wildgs.threads import fetch_add

RADIUS = 7
"""Half the side of a patch, in steps between its samples."""
SIDE = 2 * RADIUS + 1

PARAMETERS = 6
"""Of a patch's warp: displacement, then the matrix row by row."""

ITERATIONS = 12
"""Upper bound on iterations of each alignment."""
CONVERGED = 0.005
"""Displacement in the last iteration, steps between samples."""

AFFINE_PRIOR = 0.01
"""Weight of the matrix that the cameras say, relative to a patch of norm 1 and for displacements of its edge."""

LEAST_CONTRAST = 2.0
"""Smallest standard deviation of a patch's grey values, of 255."""

ALIKE, FIRST_ALIKE = 0.85, 0.75
"""Smallest correlation of an aligned patch with the mean of all of the point's aligned patches, and with the
patch of the reference, with which the first alignment is done."""

LEAST_SIZE = 0.05
"""Smallest area of a patch, relative to that of the reference."""

FARTHEST = 3.0
"""Largest displacement, steps between samples."""

_MATHS = {"reassoc", "contract", "arcp", "nsz"}


@njit(nogil=True, fastmath=_MATHS, error_model="numpy")
def align_tracks(counter, windows, places, warps, starts, references, weights, moves, likeness):
    """Aligns the observations of points with each other.

    Args:
        counter: Number of points that threads have taken.
        windows: Grey values around each observation, [O, S, S].
        places: Column and row of the observation in its window, [O, 2].
        warps: Matrices from steps between samples to pixels of the window, as the cameras say, [O, 2, 2]; replaced
            by the aligned ones.
        starts: Row of each point's first observation, and the number of observations, [P + 1].
        references: Row of the observation that stays where it is, [P].
        weights: Weight of each sample of a patch, [SIDE * SIDE], with the sum 1.
        moves: Displacement of each observation, pixels of its window, [O, 2]; written.
        likeness: Correlation with the mean of the point's patches; -1 for observations that were not aligned, [O].
    """
    samples = SIDE * SIDE
    template, patch, total = np.empty(samples), np.empty(samples), np.empty(samples)
    jacobian = np.empty((PARAMETERS, samples))
    inverse = np.empty((PARAMETERS, PARAMETERS))
    while True:
        point = fetch_add(counter, 1)
        if point >= len(references):
            break
        reference = references[point]
        first, last = starts[point], starts[point + 1]
        for row in range(first, last):
            moves[row, 0] = moves[row, 1] = 0.0
            likeness[row] = -1.0
        if not _sample(
            windows[reference], places[reference], warps[reference], moves[reference], weights, template
        ):
            continue
        _prepare(template, weights, jacobian, inverse)
        patches = 1
        for sample in range(samples):
            total[sample] = template[sample]
        for row in range(first, last):
            if row == reference:
                continue
            likeness[row] = _align(
                windows[row], places[row], warps[row], moves[row], template, weights, jacobian, inverse, patch
            )
            if likeness[row] >= FIRST_ALIKE:
                patches += 1
                for sample in range(samples):
                    total[sample] += patch[sample]
        if patches == 1:
            _fill(likeness, first, last, -1.0)
            continue
        for sample in range(samples):
            template[sample] = total[sample]
        _normalise(template, weights, 0.0)
        _prepare(template, weights, jacobian, inverse)
        likeness[reference] = 1.0
        aligned = 0
        for row in range(first, last):
            if row != reference and likeness[row] >= FIRST_ALIKE:
                likeness[row] = _align(
                    windows[row],
                    places[row],
                    warps[row],
                    moves[row],
                    template,
                    weights,
                    jacobian,
                    inverse,
                    patch,
                )
            if likeness[row] >= ALIKE:
                aligned += 1
            else:
                likeness[row] = -1.0
        if aligned < 2:
            _fill(likeness, first, last, -1.0)


@njit(nogil=True, fastmath=_MATHS, error_model="numpy")
def _fill(values, first, last, value):
    for row in range(first, last):
        values[row] = value


@njit(nogil=True, fastmath=_MATHS, error_model="numpy")
def _sample(window, place, warp, move, weights, patch):
    """Samples a patch and normalises it; False if it leaves the window or has hardly any contrast."""
    size = len(window)
    x0, y0 = place[0] + move[0], place[1] + move[1]
    sample = 0
    for j in range(-RADIUS, RADIUS + 1):
        for i in range(-RADIUS, RADIUS + 1):
            x = x0 + warp[0, 0] * i + warp[0, 1] * j
            y = y0 + warp[1, 0] * i + warp[1, 1] * j
            if not (0.0 <= x < size - 1 and 0.0 <= y < size - 1):
                return False
            left, top = int(x), int(y)
            a, b = x - left, y - top
            upper = window[top, left] * (1.0 - a) + window[top, left + 1] * a
            lower = window[top + 1, left] * (1.0 - a) + window[top + 1, left + 1] * a
            patch[sample] = upper * (1.0 - b) + lower * b
            sample += 1
    return _normalise(patch, weights, LEAST_CONTRAST)


@njit(nogil=True, fastmath=_MATHS, error_model="numpy")
def _normalise(patch, weights, least):
    """Gives a patch mean 0 and norm 1; False if its standard deviation is not larger than `least`."""
    mean = 0.0
    for sample in range(len(patch)):
        mean += weights[sample] * patch[sample]
    square = 0.0
    for sample in range(len(patch)):
        patch[sample] -= mean
        square += weights[sample] * patch[sample] * patch[sample]
    spread = np.sqrt(square)
    if spread <= least:
        return False
    for sample in range(len(patch)):
        patch[sample] /= spread
    return True


@njit(nogil=True, fastmath=_MATHS, error_model="numpy")
def _prepare(template, weights, jacobian, hessian):
    """Derivatives of a normalised patch by the warp's parameters, times the weights, and the inverse Hessian."""
    for j in range(SIDE):
        for i in range(SIDE):
            sample = j * SIDE + i
            left, right = max(i - 1, 0), min(i + 1, SIDE - 1)
            top, bottom = max(j - 1, 0), min(j + 1, SIDE - 1)
            across = (template[j * SIDE + right] - template[j * SIDE + left]) / (right - left)
            down = (template[bottom * SIDE + i] - template[top * SIDE + i]) / (bottom - top)
            jacobian[0, sample] = across
            jacobian[1, sample] = down
            jacobian[2, sample] = across * (i - RADIUS)
            jacobian[3, sample] = across * (j - RADIUS)
            jacobian[4, sample] = down * (i - RADIUS)
            jacobian[5, sample] = down * (j - RADIUS)
    for k in range(PARAMETERS):
        mean = along = 0.0
        for sample in range(SIDE * SIDE):
            mean += weights[sample] * jacobian[k, sample]
            along += weights[sample] * jacobian[k, sample] * template[sample]
        for sample in range(SIDE * SIDE):
            jacobian[k, sample] -= mean + along * template[sample]
    for k in range(PARAMETERS):
        for m in range(k + 1):
            product = 0.0
            for sample in range(SIDE * SIDE):
                product += weights[sample] * jacobian[k, sample] * jacobian[m, sample]
            hessian[k, m] = hessian[m, k] = product
    for k in range(PARAMETERS):
        hessian[k, k] += 1e-3 * hessian[k, k] + 1e-9
        if k >= 2:
            hessian[k, k] += AFFINE_PRIOR * RADIUS**2
    _invert(hessian)
    for k in range(PARAMETERS):
        for sample in range(SIDE * SIDE):
            jacobian[k, sample] *= weights[sample]


@njit(nogil=True, fastmath=_MATHS, error_model="numpy")
def _invert(matrix):
    """Inverts a positive definite matrix in place, by Gauss and Jordan: Numba takes seconds to compile LAPACK's."""
    count = len(matrix)
    for k in range(count):
        pivot = 1.0 / matrix[k, k]
        matrix[k, k] = 1.0
        for m in range(count):
            matrix[k, m] *= pivot
        for n in range(count):
            if n != k:
                factor = matrix[n, k]
                matrix[n, k] = 0.0
                for m in range(count):
                    matrix[n, m] -= factor * matrix[k, m]


@njit(nogil=True, fastmath=_MATHS, error_model="numpy")
def _align(window, place, warp, move, template, weights, jacobian, inverse, patch):
    """Moves a patch to where it is most like the template; returns the correlation, or -1.

    `warp` and `move` are replaced, `patch` receives the aligned patch.
    """
    size = warp[0, 0] * warp[1, 1] - warp[0, 1] * warp[1, 0]
    if not abs(size) > LEAST_SIZE:
        return -1.0
    limit = FARTHEST * np.sqrt(abs(size))
    gradient, step = np.empty(PARAMETERS), np.empty(PARAMETERS)
    change, before = np.empty((2, 2)), np.empty((2, 2))
    for k in range(2):
        for m in range(2):
            change[k, m], before[k, m] = 0.0, warp[k, m]
    correlation, converged = -1.0, False
    for _ in range(ITERATIONS + 1):
        if not _sample(window, place, warp, move, weights, patch):
            return -1.0
        correlation = 0.0
        for sample in range(len(patch)):
            correlation += weights[sample] * patch[sample] * template[sample]
        if converged:
            break
        for k in range(PARAMETERS):
            gradient[k] = 0.0
            for sample in range(len(patch)):
                gradient[k] += jacobian[k, sample] * (patch[sample] - template[sample])
        for k in range(4):
            gradient[k + 2] += AFFINE_PRIOR * RADIUS**2 * change[k // 2, k % 2]
        for k in range(PARAMETERS):
            step[k] = 0.0
            for m in range(PARAMETERS):
                step[k] += inverse[k, m] * gradient[m]
        length = np.hypot(step[0], step[1])
        if length > 1.0:
            for k in range(PARAMETERS):
                step[k] /= length
        if not _compose(warp, move, step):
            return -1.0
        for k in range(2):
            change[0, k] = (before[1, 1] * warp[0, k] - before[0, 1] * warp[1, k]) / size - (1 - k)
            change[1, k] = (before[0, 0] * warp[1, k] - before[1, 0] * warp[0, k]) / size - k
        if move[0] * move[0] + move[1] * move[1] > limit * limit:
            return -1.0
        converged = length < CONVERGED
    return correlation


@njit(nogil=True, fastmath=_MATHS, error_model="numpy")
def _compose(warp, move, step):
    """Applies a warp after the inverse of a step; False if the step has none."""
    a, b, c, d = 1.0 + step[2], step[3], step[4], 1.0 + step[5]
    area = a * d - b * c
    if not area > LEAST_SIZE:
        return False
    for k in range(2):
        left, right = warp[k, 0], warp[k, 1]
        warp[k, 0] = (left * d - right * c) / area
        warp[k, 1] = (right * a - left * b) / area
        move[k] -= warp[k, 0] * step[0] + warp[k, 1] * step[1]
    return True
