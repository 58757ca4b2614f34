"""Thumbnails as data URLs, for web pages and JSON."""

from __future__ import annotations

import base64
import io

import numpy as np
from jaxtyping import UInt8
from PIL import Image

THUMBNAIL = (288, 192)
_QUALITY = 82


def thumbnail_url(pixels: UInt8[np.ndarray, "H W 3"]) -> str:
    """Centre crop of an image as a data URL."""
    image = Image.fromarray(np.ascontiguousarray(pixels))
    wide, tall = THUMBNAIL
    scale = max(wide / image.width, tall / image.height)
    left, top = (image.width - wide / scale) / 2, (image.height - tall / scale) / 2
    box = (max(left, 0), max(top, 0), image.width - max(left, 0), image.height - max(top, 0))
    buffer = io.BytesIO()
    image.resize(THUMBNAIL, Image.Resampling.LANCZOS, box=box).save(buffer, "JPEG", quality=_QUALITY)
    return "data:image/jpeg;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")
