"""Configuration of reading a scene folder."""

from __future__ import annotations

import re
from dataclasses import dataclass

from wildgs.errors import UserError

MAX_IMAGE_PIXELS = 250_000_000
"""Images with more pixels are rejected before decoding: a small file can decode to more than memory holds."""

DECODERS = 4
"""Number of threads that decode photos; Pillow releases the GIL."""

_UNITS = {"": 1, "B": 1} | {
    prefix + ending: base ** (power + 1)
    for power, prefix in enumerate("KMGT")
    for ending, base in (("", 1000), ("B", 1000), ("IB", 1024))
}

IMAGE_CACHE = "4GB"
"""Default size of the cache of decoded photos."""


@dataclass(frozen=True)
class DataConfig:
    """How a scene folder is read."""

    downscale: int | float = 1
    """Factor by which the photos' width and height are divided (paper: 2 on Phototourism)."""
    max_side: int | None = None
    """Longest side of a photo in pixels, after --downscale; larger photos are reduced to it, smaller ones are not
    changed."""
    holdout: int = 8
    """Hold out every n-th photo for testing if the scene has no .tsv split; 0 = train on all photos."""
    use_masks: bool = True
    """Use the masks in the scene's masks/ folder (0 = ignore the pixel)."""
    use_depth: bool = True
    """Use the depth maps in the scene's depth/ folder."""
    use_metric_depth: bool = True
    """Use those with metric depth (.tiff) too, for example by stereo."""
    max_image_pixels: int = MAX_IMAGE_PIXELS
    """Skip photos with more pixels without decoding them."""

    def __post_init__(self) -> None:
        """Validates the values."""
        if not 1 <= self.downscale < float("inf"):
            raise UserError(f"--downscale {self.downscale}: must be 1 (full size) or more")
        if self.max_side is not None and self.max_side < 1:
            raise UserError(f"--max-side {self.max_side}: must be above 0")
        if self.holdout < 0 or self.holdout == 1:
            raise UserError(f"--holdout {self.holdout}: must be 0 (train on all photos) or at least 2")
        if self.max_image_pixels < 1:
            raise UserError(f"--max-image-pixels {self.max_image_pixels}: must be above 0")


def parse_bytes(text: str) -> int:
    """Converts a size such as ``4GB``, ``500 MB`` or ``2GiB`` to bytes.

    Raises:
        UserError: The text is not a size.
    """
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*([A-Za-z]*)\s*", text)
    if match is None or match[2].upper() not in _UNITS:
        raise UserError(f"{text!r} is not a size; write it as 4GB, 500MB or 2GiB")
    return int(float(match[1]) * _UNITS[match[2].upper()])
