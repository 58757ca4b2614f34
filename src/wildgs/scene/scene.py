"""Views, scenes and their alignment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from wildgs.devices import upload
from wildgs.errors import UserError
from wildgs.geometry.camera import Camera
from wildgs.scene.photo_store import PhotoStore
from wildgs.scene.residuals import Residuals

Split = Literal["train", "test"]
MAX_LISTED = 3
"""Number of photos that a message names."""

LEAST_PHOTOS = 3
"""Smallest number of photos in which a point is observed to be taken as static."""


@dataclass(frozen=True)
class Alignment:
    """The similarity transform from the frame of the COLMAP model to the aligned frame.

    ``aligned = scale * rotation @ input + translation``, in double precision, because georeferenced models may be
    far from the origin.
    """

    rotation: Float[Tensor, "3 3"]
    translation: Float[Tensor, "3"]
    scale: float = 1.0

    @classmethod
    def identity(cls) -> Alignment:
        """The identity transform."""
        return cls(torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))

    def inverse(self) -> Alignment:
        """The transform from the aligned frame to that of the COLMAP model."""
        back = self.rotation.T
        return Alignment(back, -(back @ self.translation) / self.scale, 1.0 / self.scale)

    def apply_points(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Transforms points, keeping their dtype."""
        rotation, translation = self.rotation.to(points.device), self.translation.to(points.device)
        moved = self.scale * points.to(rotation) @ rotation.T + translation
        return moved.to(points.dtype)

    def apply_camera(self, camera: Camera) -> Camera:
        """Transforms a camera.

        Camera space is scaled as well (depths are multiplied by `scale`); the image does not change.
        """
        device = camera.viewmat.device
        rotation, translation = self.rotation.to(device), self.translation.to(device)
        viewmat = camera.viewmat.to(rotation).clone()
        viewmat[:3, :3] = viewmat[:3, :3] @ rotation.T
        viewmat[:3, 3] = self.scale * viewmat[:3, 3] - viewmat[:3, :3] @ translation
        return replace(camera, viewmat=viewmat.to(camera.viewmat.dtype))

    def to_dict(self) -> dict[str, Any]:
        """Converts the transform to plain numbers, without loss."""
        return {
            "rotation": self.rotation.tolist(),
            "translation": self.translation.tolist(),
            "scale": float(self.scale),
        }

    @classmethod
    def from_dict(cls, numbers: Mapping[str, Any]) -> Alignment:
        """The inverse of `to_dict`."""
        return cls(
            rotation=torch.tensor(numbers["rotation"], dtype=torch.float64),
            translation=torch.tensor(numbers["translation"], dtype=torch.float64),
            scale=float(numbers["scale"]),
        )


@dataclass(frozen=True)
class View:
    """A photo with its camera in the aligned frame.

    Pixels are read from the photo store on demand. The results are shared and must not be modified.

    Attributes:
        name: Path relative to the scene's image folder; unique within the scene.
        camera: Pinhole camera for the photo after downscaling.
        split: Whether this is a training or a test photo.
        photos: The photo store.
    """

    name: str
    camera: Camera
    split: Split
    photos: PhotoStore = field(repr=False, compare=False)

    def read_photo(self) -> UInt8[Tensor, "H W 3"]:
        """RGB at the camera's size.

        Raises:
            UserError: The photo cannot be read.
        """
        return torch.from_numpy(self.photos.get(self.name).pixels)

    def read_mask(self) -> UInt8[Tensor, "H W"] | None:
        """Mask of the user and of transparent pixels: 0 = ignore; None if no pixel is ignored."""
        mask = self.photos.get(self.name).mask
        return None if mask is None else torch.from_numpy(mask)

    def read_disparity(self) -> Float[Tensor, "H W"] | None:
        """Disparity in [0, 1] of unknown scale and shift, large = near, 0 = no estimate; None if there is none."""
        disparity = self.photos.get(self.name).disparity
        return None if disparity is None else torch.from_numpy(disparity.astype(np.float32) / 65535.0)

    def read_depth(self) -> Float[Tensor, "H W"] | None:
        """Metric depth along the camera's z axis in units of the scene, 0 = no estimate; None if there is none."""
        depth = self.photos.get(self.name).depth
        return None if depth is None else torch.from_numpy(depth)

    def read_clean(self) -> UInt8[Tensor, "H W 3"] | None:
        """The photo without transients (ground truth, for evaluation only); None if there is none."""
        clean = self.photos.read_clean(self.name)
        return None if clean is None else torch.from_numpy(clean)

    def read_truth_mask(self) -> UInt8[Tensor, "H W"] | None:
        """Ground truth mask: 255 = static, 0 = transient; None if there is none."""
        mask = self.photos.read_truth_mask(self.name)
        return None if mask is None else torch.from_numpy(mask)

    def prefetch(self) -> None:
        """Announces that this photo is needed soon."""
        self.photos.prefetch(self.name)

    def load(self, device: torch.device) -> tuple[Float[Tensor, "H W 3"], Bool[Tensor, "H W"] | None]:
        """The photo on a device: RGB in [0, 1], and the mask of pixels to use (False = ignore; None = all)."""
        mask = self.read_mask()
        mask = None if mask is None else upload(mask, device)
        return converted(upload(self.read_photo(), device), mask)


def converted(
    pixels: UInt8[Tensor, "H W 3"], mask: UInt8[Tensor, "H W"] | None
) -> tuple[Float[Tensor, "H W 3"], Bool[Tensor, "H W"] | None]:
    """Converts a photo and its mask (see `View.read_mask`) on their device to the result of `View.load`."""
    return pixels.float() / 255, None if mask is None else mask > 0


def to_unit(pixels: UInt8[Tensor, "H W 3"], device: torch.device) -> Float[Tensor, "H W 3"]:
    """Converts 8-bit RGB to floats in [0, 1] on a device."""
    return converted(upload(pixels, device), None)[0]


@dataclass(frozen=True)
class Scene:
    """A photo collection with cameras and sparse points in the aligned frame.

    In the aligned frame, +z is up, and x and y are the principal axes of the points in the ground plane.

    Attributes:
        root: The scene folder.
        views: All registered photos, sorted by name.
        points: Sparse points from SfM.
        point_colors: Colours of the points.
        alignment: Transform from the COLMAP model's frame to the aligned frame.
        observations: Index in `views` and index in `points` of each observation of a point in a photo.
        residuals: Residuals of SfM by the names of photos; empty if the scene was not loaded from a COLMAP model.
    """

    root: Path
    views: tuple[View, ...]
    points: Float[Tensor, "P 3"]
    point_colors: UInt8[Tensor, "P 3"]
    alignment: Alignment
    observations: Int[Tensor, "T 2"] = field(default_factory=lambda: torch.zeros(0, 2, dtype=torch.int32))
    residuals: Mapping[str, Residuals] = field(default_factory=dict)

    @property
    def train_views(self) -> tuple[View, ...]:
        """The training photos, sorted by name."""
        return tuple(v for v in self.views if v.split == "train")

    @property
    def test_views(self) -> tuple[View, ...]:
        """The held-out photos, sorted by name."""
        return tuple(v for v in self.views if v.split == "test")


def observations_of(
    observations: Int[Tensor, "T 2"], names: Sequence[str], views: Sequence[View]
) -> Int[Tensor, "U 2"]:
    """Converts observations from indices in `names` to indices in `views`; drops those of other photos."""
    rows = {view.name: row for row, view in enumerate(views)}
    row_of = torch.tensor([rows.get(name, -1) for name in names], dtype=torch.int32)
    moved = torch.stack([row_of[observations[:, 0].long()], observations[:, 1]], dim=1)
    return moved[moved[:, 0] >= 0]


def observed_rows(scene: Scene, view: View) -> Int[Tensor, " K"]:
    """Rows of the points that a photo of the scene observes."""
    row = next(index for index, other in enumerate(scene.views) if other.name == view.name)
    return scene.observations[scene.observations[:, 0] == row, 1].unique().long()


def observed_pixels(
    scene: Scene, least_photos: int = LEAST_PHOTOS, split: Split = "train"
) -> dict[str, Float[Tensor, "K 2"]]:
    """Pixels (x, y) at which photos observe reliable points, by the photo's name.

    Args:
        scene: The scene with observations.
        least_photos: Smallest number of photos in which a point is observed.
        split: Photos of this split only.
    """
    pairs = scene.observations.long().unique(dim=0)
    photos = pairs[:, 1].bincount(minlength=len(scene.points))
    pairs = pairs[photos[pairs[:, 1]] >= least_photos]
    parts = pairs[:, 1].split(pairs[:, 0].bincount(minlength=len(scene.views)).tolist())
    pixels = {}
    for view, rows in zip(scene.views, parts, strict=True):
        if view.split == split and len(rows):
            found, depth = view.camera.project(scene.points[rows])
            size = torch.tensor([view.camera.width, view.camera.height])
            pixels[view.name] = found[(depth > 0) & ((found >= 0) & (found < size)).all(dim=1)]
    return pixels


def scene_extent(scene: Scene) -> float:
    """The scene extent, by which 3DGS scales learning rates and thresholds of densification.

    1.1 times the largest distance of a training camera from the mean of the cameras, as in 3DGS. If all cameras
    have the same position, the median distance of the points from them is used instead.

    Raises:
        ValueError: The scene has no training views.
    """
    if not scene.train_views:
        raise ValueError("a scene without training views has no extent")
    positions = torch.stack([view.camera.position for view in scene.train_views])
    centre = positions.mean(dim=0)
    radius = float((positions - centre).norm(dim=-1).max())
    distance = float((scene.points - centre).norm(dim=-1).median()) if len(scene.points) else 1.0
    return 1.1 * (radius if radius > 1e-3 * distance else distance)


def find_view(scene: Scene, name: str) -> View:
    """The view of a photo by its name with or without extension.

    Raises:
        UserError: The scene has no such photo, or several.
    """
    view = match_view(scene.views, name)
    if view is None:
        raise UserError(
            f"{scene.root} has no photo {name!r} with a camera; names are as in its images/ folder"
        )
    return view


def match_view(views: Sequence[View], name: str) -> View | None:
    """The view of a photo by its name with or without extension, or None.

    Raises:
        UserError: Several photos have this name without extension.
    """
    found = [view for view in views if view.name == name]
    found = found or [view for view in views if str(Path(view.name).with_suffix("")) == name]
    if len(found) > 1:
        several = ", ".join(view.name for view in found[:MAX_LISTED])
        more = ", …" if len(found) > MAX_LISTED else ""
        raise UserError(f"{name!r} may be any of {several}{more}; give the name with its extension")
    return found[0] if found else None
