"""Colour maps for depth, and masks over photos."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, UInt8

# Nine entries of matplotlib's perceptually uniform colour map "inferno" (CC0).
_INFERNO = np.array(
    [
        (0, 0, 4),
        (31, 12, 72),
        (85, 15, 109),
        (136, 34, 106),
        (186, 54, 85),
        (227, 89, 51),
        (249, 140, 10),
        (249, 201, 50),
        (252, 255, 164),
    ],
    dtype=float,
)
_NO_DEPTH = (128, 128, 128)
HIDDEN_TINT = np.array([230.0, 40.0, 40.0])


def color_depth(depth: Float[np.ndarray, "H W"]) -> UInt8[np.ndarray, "H W 3"]:
    """Colour map of disparity: near is bright, far is dark, missing depth (0 or non-finite) is grey."""
    valid = np.isfinite(depth) & (depth > 0.0)
    picture = np.empty((*depth.shape, 3), dtype=np.uint8)
    picture[:] = _NO_DEPTH
    if not valid.any():
        return picture
    disparity = 1.0 / depth[valid]
    low, high = np.quantile(disparity, [0.01, 0.99])
    share = np.clip((disparity - low) / max(high - low, 1e-12), 0.0, 1.0)
    stops = np.linspace(0.0, 1.0, len(_INFERNO))
    channels = [np.interp(share, stops, _INFERNO[:, c]) for c in range(3)]
    picture[valid] = np.stack(channels, axis=-1).round().astype(np.uint8)
    return picture


def tint_hidden(
    photo: UInt8[np.ndarray, "H W 3"], visibility: Float[np.ndarray, "H W"]
) -> UInt8[np.ndarray, "H W 3"]:
    """The photo in grey, tinted red where the visibility M is low."""
    grey = photo.mean(axis=2, keepdims=True).repeat(3, axis=2)
    hidden = (1 - np.clip(visibility, 0, 1))[..., None]
    return ((1 - 0.8 * hidden) * grey + 0.8 * hidden * HIDDEN_TINT).round().astype(np.uint8)
