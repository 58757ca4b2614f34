"""Configuration of structure from motion."""

from __future__ import annotations

from dataclasses import dataclass, field

from wildgs.errors import UserError
from wildgs.scene.config import MAX_IMAGE_PIXELS

CONFIRMED = 3
"""Number of photos from which a point moves cameras."""


@dataclass(frozen=True)
class PairingConfig:
    """Selection of image pairs to match."""

    exhaustive_features: int = 500_000
    """Match all pairs if the photos have at most this many features in total, for example 60 photos of 8,192
    features. Matching time grows with the square."""
    neighbours: int = 32
    """Number of photos to match each photo with in larger sets."""
    gps_share: float = 0.8
    """Choose pairs by GPS position if at least this fraction of the photos has one."""
    gps_distance: float = 200.0
    """Largest distance, in metres, between photos paired by GPS."""


@dataclass(frozen=True)
class SfmConfig:
    """Structure from motion."""

    pairing: PairingConfig = field(default_factory=PairingConfig)
    """Selection of image pairs to match."""
    max_image_size: int = 2000
    """Longest side in pixels at which features are extracted."""
    max_features: int = 8192
    """Upper bound on the number of features per photo."""
    max_image_pixels: int = MAX_IMAGE_PIXELS
    """Skip photos with more pixels."""
    affine_features: bool = False
    """Estimate the affine shape of features, which matches oblique views better; extraction takes 1.4 times as
    long."""
    second_chance: bool = True
    """Run the second and third pass: match photos without a pose to 3D points, and to more photos."""
    threads: int = -1
    """CPU threads; -1 = all."""
    seed: int = 0
    """Random seed of matching and mapping."""

    def __post_init__(self) -> None:
        for name in ("max_image_size", "max_features", "max_image_pixels"):
            if getattr(self, name) < 1:
                raise UserError(f"--{name.replace('_', '-')} {getattr(self, name)}: must be 1 or more")
        if self.threads != -1 and self.threads < 1:
            raise UserError(f"--threads {self.threads}: must be 1 or more, or -1 for all")
