"""Configuration of structure from motion."""

from __future__ import annotations

from dataclasses import dataclass, field

from wildgs.errors import UserError
from wildgs.scene.config import MAX_IMAGE_PIXELS


@dataclass(frozen=True)
class PairingConfig:
    """When and how partners are chosen."""

    exhaustive_limit: int = 60
    """Sets of up to this many photos are matched all with all."""
    neighbours: int = 16
    """Partners per photo in larger sets."""
    gps_share: float = 0.8
    """Share of the photos that must carry a GPS position for neighbours to be chosen by it."""
    gps_distance: float = 200.0
    """Photos farther apart than this, in metres, are no neighbours by GPS."""


@dataclass(frozen=True)
class SfmConfig:
    """Structure from motion."""

    pairing: PairingConfig = field(default_factory=PairingConfig)
    """Which photos are matched with which."""
    max_image_size: int = 2000
    """Features are sought at no more than this many pixels on the long side."""
    max_features: int = 8192
    """Features per photo."""
    max_image_pixels: int = MAX_IMAGE_PIXELS
    """Photos with more pixels are left out."""
    affine_features: bool = False
    """Whether features have an affine shape, which survives oblique views; finding them takes 1.4 times as long."""
    second_chance: bool = True
    """Whether photos without a pose are matched to points, and with more partners, and tried again."""
    threads: int = -1
    """CPU threads; -1 = all."""
    seed: int = 0
    """Random seed of matching and mapping."""

    def __post_init__(self) -> None:
        for name in ("max_image_size", "max_features", "max_image_pixels"):
            if getattr(self, name) < 1:
                raise UserError(f"{name.replace('_', '-')} {getattr(self, name)}: must be 1 or more")
        if self.threads != -1 and self.threads < 1:
            raise UserError(f"threads {self.threads}: must be 1 or more, or -1 for all")
