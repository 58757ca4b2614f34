"""Configuration of reading a scene folder."""

from __future__ import annotations

import re
from dataclasses import dataclass

from wildgs.errors import UserError

MAX_IMAGE_PIXELS = 250_000_000
"""Pictures with more pixels are refused unread: a small file can unpack to more than the memory holds."""


_UNITS = {"": 1, "B": 1} | {
    prefix + ending: base ** (power + 1)
    for power, prefix in enumerate("KMGT")
    for ending, base in (("", 1000), ("B", 1000), ("IB", 1024))
}

IMAGE_CACHE = "4GB"
"""Memory for decoded photos unless another size is asked for."""


@dataclass(frozen=True)
class DataConfig:
    """How a scene folder is read."""

    downscale: int | float = 1
    """Divides the photos' width and height (the paper: 2 on Phototourism)."""
    max_side: int | None = None
    """Reduces each photo, after --downscale, so that its own longer side is at most this many pixels; smaller ones
    stay as they are."""
    holdout: int = 8
    """Every n-th photo tests where the scene has no .tsv split; 0 = all train."""
    use_masks: bool = True
    """Read the user's masks/ (0 = ignore)."""
    use_depth: bool = True
    """Read the depth prior in depth/."""
    max_image_pixels: int = MAX_IMAGE_PIXELS
    """Pictures with more pixels are left out unread."""

    def __post_init__(self) -> None:
        """Refuse values that mean nothing."""
        if not 1 <= self.downscale < float("inf"):
            raise UserError(f"downscale {self.downscale}: must be 1 (full size) or more")
        if self.max_side is not None and self.max_side < 1:
            raise UserError(f"max-side {self.max_side}: must be above 0")
        if self.holdout < 0 or self.holdout == 1:
            raise UserError(f"holdout {self.holdout}: must be 0 (all photos train) or at least 2")
        if self.max_image_pixels < 1:
            raise UserError(f"max-image-pixels {self.max_image_pixels}: must be above 0")


def parse_bytes(text: str) -> int:
    """A size such as ``4GB``, ``500 MB`` or ``2GiB`` in bytes.

    Raises:
        UserError: It is none.
    """
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*([A-Za-z]*)\s*", text)
    if match is None or match[2].upper() not in _UNITS:
        raise UserError(f"{text!r} is not a size; write it as 4GB, 500MB or 2GiB")
    return int(float(match[1]) * _UNITS[match[2].upper()])
