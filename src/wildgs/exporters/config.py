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
    """Reduction of exported files.

    Attributes:
        min_opacity: Drop Gaussians with a lower opacity.
        max_distance: Drop Gaussians farther than this from the median of the SfM points, in units of the aligned
            frame (median depth of the photos = 1); None keeps all.
        crop: Drop Gaussians outside the bounding box of nearly all SfM points, scaled by this factor; None keeps
            all.
        drop_sky: Drop the Gaussians of the sky.
        sh_degree: Truncate spherical harmonics to this degree, fitted to the viewing directions of the photos; None
            keeps all degrees.
        own_harmonics: For .glb files with several lights: fraction of the Gaussians that have separate harmonics
            above degree 0 for each light; the others use the same ones for all lights. 1 = all separate.
    """

    min_opacity: float = 0.0
    max_distance: float | None = None
    crop: float | None = None
    drop_sky: bool = False
    sh_degree: int | None = None
    own_harmonics: float = 0.09

    def __post_init__(self) -> None:
        """Validates the values; NaN is rejected as well."""
        for name, (least, most) in _RANGES.items():
            value = getattr(self, name)
            if value is not None and not least <= value <= most:
                raise UserError(f"--{name.replace('_', '-')} {value}: must be from {least:g} to {most:g}")

    @property
    def active(self) -> bool:
        """Whether any option may drop something."""
        return replace(self, own_harmonics=CleanupConfig.own_harmonics) != CleanupConfig()
