"""CPU kernels of `wildgs.model.camera_response.responded` and its gradient: one pass over the pixels each."""

from __future__ import annotations

import numpy as np

from wildgs.kernel_cache import njit
from wildgs.threads import fetch_add

CHUNK = 1024  # pixels per work item


@njit(nogil=True, fastmath=True, error_model="numpy")
def respond(counter, colors, radius, response, gradient, backward, out):
    """out[p, c] = the curve at the exposed colour; with `backward`, its derivative times gradient[p, c].

    Arrays of pixels are flat: colours, gradient and `out` have 3 elements per pixel.
    """
    one, two, six = np.float32(1), np.float32(2), np.float32(6)
    gains = np.empty(3 * CHUNK, np.float32)
    # Repeated for each element, so that the loop over elements is vectorised.
    first, second = np.empty(3 * CHUNK, np.float32), np.empty(3 * CHUNK, np.float32)
    for p in range(CHUNK):
        for c in range(3):
            first[3 * p + c], second[3 * p + c] = response[2 + 2 * c], response[3 + 2 * c]
    while True:
        start = fetch_add(counter, 1) * CHUNK
        if start >= len(radius):
            break
        count = min(CHUNK, len(radius) - start)
        for p in range(count):
            r = radius[start + p]
            gains[3 * p] = gains[3 * p + 1] = gains[3 * p + 2] = one + r * (response[0] + response[1] * r)
        for k in range(3 * count):
            exposed = colors[3 * start + k] * gains[k]
            x = min(max(exposed, np.float32(0)), one)
            if backward:
                slope = first[k] * (one - two * x) + second[k] * (one + six * x * (x - one))
                inside = one if x == exposed else np.float32(0)
                out[3 * start + k] = (one + inside * slope) * gains[k] * gradient[3 * start + k]
            else:
                out[3 * start + k] = exposed + x * (one - x) * (first[k] + second[k] * (one - two * x))
