"""Configuration of exports."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class CleanupConfig:
    """What an export leaves out.

    Attributes:
        min_opacity: Gaussians fainter than this are dropped.
        max_distance: Gaussians further from the scene's middle are dropped, in units of the photos' usual depth;
            None keeps all.
        crop: Gaussians outside the box that holds nearly all SfM points, times this, are dropped: 1 is that
            box; None keeps all.
        sh_degree: Spherical harmonics above this degree are left out (fitted to the photos' directions).
    """

    min_opacity: float = 0.0
    max_distance: float | None = None
    crop: float | None = None
    sh_degree: int | None = None

    @property
    def active(self) -> bool:
        """Whether anything may be left out."""
        return self != CleanupConfig()
