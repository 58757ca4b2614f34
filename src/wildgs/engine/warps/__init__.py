"""Displaces training photos by fractions of a pixel to where the scene says that they belong."""

from wildgs.engine.warps.photo_warps import PhotoWarps

__all__ = ["PhotoWarps"]
