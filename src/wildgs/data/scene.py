"""Views and scenes: what training, evaluation and rendering read."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from jaxtyping import Float, UInt8
from torch import Tensor

from wildgs.geometry.camera import Camera

Split = Literal["train", "test"]


@dataclass(frozen=True)
class Alignment:
    """The rigid motion and scale from the input's (COLMAP's) frame to the scene's aligned frame.

    ``aligned = scale * rotation @ input + translation``. Kept with the run so that exports can go back.
    """

    rotation: Float[Tensor, "3 3"]
    translation: Float[Tensor, "3"]
    scale: float = 1.0


@dataclass(frozen=True)
class View:
    """One photo with its camera, in the scene's aligned frame.

    Pixels are read on demand through the scene's readers and kept as 8 bits.

    Attributes:
        name: Path relative to the scene's image folder; unique within the scene.
        camera: Pinhole camera at the size at which the photo is used (after downscaling).
        split: Whether the photo trains or tests.
    """

    name: str
    camera: Camera
    split: Split
    read_photo: Callable[[], UInt8[Tensor, "H W 3"]] = field(repr=False, compare=False)
    read_mask: Callable[[], UInt8[Tensor, "H W"] | None] = field(repr=False, compare=False)
    read_disparity: Callable[[], Float[Tensor, "H W"] | None] = field(repr=False, compare=False)
    read_clean: Callable[[], UInt8[Tensor, "H W 3"] | None] = field(repr=False, compare=False)
    read_truth_mask: Callable[[], UInt8[Tensor, "H W"] | None] = field(repr=False, compare=False)


@dataclass(frozen=True)
class Scene:
    """A photo collection with cameras and sparse points, axes aligned.

    In the aligned frame, +z is up, and x and y are the principal axes of the points in the ground plane.

    Attributes:
        root: The folder it was read from.
        views: All registered photos, sorted by name.
        points: Sparse points from SfM.
        point_colors: Their colours.
        alignment: From the input's frame to this one.
    """

    root: Path
    views: tuple[View, ...]
    points: Float[Tensor, "P 3"]
    point_colors: UInt8[Tensor, "P 3"]
    alignment: Alignment

    @property
    def train_views(self) -> tuple[View, ...]:
        """The photos that train, in name order."""
        return tuple(v for v in self.views if v.split == "train")

    @property
    def test_views(self) -> tuple[View, ...]:
        """The photos that are held out, in name order."""
        return tuple(v for v in self.views if v.split == "test")
