"""Configuration of exports."""

from __future__ import annotations

from dataclasses import dataclass, replace

from wildgs.errors import UserError

_RANGES = {
    "min_opacity": (0, 1),
    "max_distance": (0, 1e9),
    "crop": (0, 1e9),
    "sh_degree": (0, 3),
    "own_harmonics": (0, 1),
}


@dataclass(frozen=True)
class CleanupConfig:
    """What an export drops.

    Attributes:
        min_opacity: Gaussians with a lower opacity are dropped.
        max_distance: Gaussians further from the median of the SfM points are dropped. World units (the median depth
            of the photos is 1); None keeps all.
        crop: Gaussians outside the bounding box of nearly all SfM points, scaled by this factor, are dropped; None
            keeps all.
        drop_sky: The Gaussians that stand for the sky are dropped.
        sh_degree: Spherical harmonics are truncated to this degree, fitted to the viewing directions of the photos;
            None keeps all.
        own_harmonics: Of files with several lights: share of the Gaussians that keep their own harmonics above
            degree 0 in each light of a .glb; the others share them between all lights. 1 shares nothing.
    """

    min_opacity: float = 0.0
    max_distance: float | None = None
    crop: float | None = None
    drop_sky: bool = False
    sh_degree: int | None = None
    own_harmonics: float = 0.09

    def __post_init__(self) -> None:
        """Refuses values that mean nothing, NaN among them."""
        for name, (least, most) in _RANGES.items():
            value = getattr(self, name)
            if value is not None and not least <= value <= most:
                raise UserError(f"--{name.replace('_', '-')} {value}: must be from {least:g} to {most:g}")

    @property
    def active(self) -> bool:
        """Whether anything may be dropped."""
        return replace(self, own_harmonics=CleanupConfig.own_harmonics) != CleanupConfig()
