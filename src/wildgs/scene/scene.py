"""Views and scenes: what training, evaluation and rendering read."""

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

Split = Literal["train", "test"]
LEAST_PHOTOS = 3
"""Photos that triangulate a point by which something static is proven."""


@dataclass(frozen=True)
class Alignment:
    """The rigid motion and scale from the input's (COLMAP's) frame to the scene's aligned frame.

    ``aligned = scale * rotation @ input + translation``. Kept with the run so that exports can go back.
    Double precision, because georeferenced input lies far from its origin.
    """

    rotation: Float[Tensor, "3 3"]
    translation: Float[Tensor, "3"]
    scale: float = 1.0

    @classmethod
    def identity(cls) -> Alignment:
        """The alignment that changes nothing."""
        return cls(torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))

    def inverse(self) -> Alignment:
        """From the aligned frame back to the input's."""
        back = self.rotation.T
        return Alignment(back, -(back @ self.translation) / self.scale, 1.0 / self.scale)

    def apply_points(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Points carried from the input's frame to the aligned one, in the dtype in which they came."""
        rotation, translation = self.rotation.to(points.device), self.translation.to(points.device)
        moved = self.scale * points.to(rotation) @ rotation.T + translation
        return moved.to(points.dtype)

    def apply_camera(self, camera: Camera) -> Camera:
        """The camera that sees the aligned world as `camera` sees the input's.

        Camera space is scaled too (depths are `scale` times as large); the picture does not change.
        """
        device = camera.viewmat.device
        rotation, translation = self.rotation.to(device), self.translation.to(device)
        viewmat = camera.viewmat.to(rotation).clone()
        viewmat[:3, :3] = viewmat[:3, :3] @ rotation.T
        viewmat[:3, 3] = self.scale * viewmat[:3, 3] - viewmat[:3, :3] @ translation
        return replace(camera, viewmat=viewmat.to(camera.viewmat.dtype))

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers for JSON or YAML; `from_dict` reads them back without loss."""
        return {
            "rotation": self.rotation.tolist(),
            "translation": self.translation.tolist(),
            "scale": float(self.scale),
        }

    @classmethod
    def from_dict(cls, numbers: Mapping[str, Any]) -> Alignment:
        """The alignment that `to_dict` wrote."""
        return cls(
            rotation=torch.tensor(numbers["rotation"], dtype=torch.float64),
            translation=torch.tensor(numbers["translation"], dtype=torch.float64),
            scale=float(numbers["scale"]),
        )


@dataclass(frozen=True)
class View:
    """One photo with its camera, in the scene's aligned frame.

    Pixels are read from the store of photos when they are asked for. What is read is shared: not to be written to.

    Attributes:
        name: Path relative to the scene's image folder; unique within the scene.
        camera: Pinhole camera at the size at which the photo is used (after downscaling).
        split: Whether the photo trains or tests.
        photos: Where its pixels are.
    """

    name: str
    camera: Camera
    split: Split
    photos: PhotoStore = field(repr=False, compare=False)

    def read_photo(self) -> UInt8[Tensor, "H W 3"]:
        """RGB at the camera's size.

        Raises:
            UserError: The photo cannot be read (any more).
        """
        return torch.from_numpy(self.photos.get(self.name).pixels)

    def read_mask(self) -> UInt8[Tensor, "H W"] | None:
        """What the user or the file excludes: 0 = ignore; None where nothing is ignored."""
        mask = self.photos.get(self.name).mask
        return None if mask is None else torch.from_numpy(mask)

    def read_disparity(self) -> Float[Tensor, "H W"] | None:
        """Disparity in [0, 1], large = near, unknown scale and shift; 0 = no estimate; None without depth prior."""
        disparity = self.photos.get(self.name).disparity
        return None if disparity is None else torch.from_numpy(disparity.astype(np.float32) / 65535.0)

    def read_depth(self) -> Float[Tensor, "H W"] | None:
        """Metric depth along the camera's axis in the scene's units; 0 = no estimate; None where there is none."""
        depth = self.photos.get(self.name).depth
        return None if depth is None else torch.from_numpy(depth)

    def read_clean(self) -> UInt8[Tensor, "H W 3"] | None:
        """The photo without its transients, which only evaluation may look at; None where there is none."""
        clean = self.photos.read_clean(self.name)
        return None if clean is None else torch.from_numpy(clean)

    def read_truth_mask(self) -> UInt8[Tensor, "H W"] | None:
        """Where the photo truly shows the static scene (255) or a transient (0); None where that is not known."""
        mask = self.photos.read_truth_mask(self.name)
        return None if mask is None else torch.from_numpy(mask)

    def prefetch(self) -> None:
        """Says that this photo's turn comes soon."""
        self.photos.prefetch(self.name)

    def load(self, device: torch.device) -> tuple[Float[Tensor, "H W 3"], Bool[Tensor, "H W"] | None]:
        """The photo as methods take it: RGB in [0, 1], and which pixels count (False = ignore; None = all)."""
        mask = self.read_mask()
        keep = None if mask is None else upload(mask, device) > 0
        return to_unit(self.read_photo(), device), keep


def to_unit(pixels: UInt8[Tensor, "H W 3"], device: torch.device) -> Float[Tensor, "H W 3"]:
    """8-bit RGB as floats in [0, 1] on a device."""
    return upload(pixels, device).float() / 255


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
        observations: Which view (row in `views`) triangulated which point (row in `points`).
    """

    root: Path
    views: tuple[View, ...]
    points: Float[Tensor, "P 3"]
    point_colors: UInt8[Tensor, "P 3"]
    alignment: Alignment
    observations: Int[Tensor, "T 2"] = field(default_factory=lambda: torch.zeros(0, 2, dtype=torch.int32))

    @property
    def train_views(self) -> tuple[View, ...]:
        """The photos that train, in name order."""
        return tuple(v for v in self.views if v.split == "train")

    @property
    def test_views(self) -> tuple[View, ...]:
        """The photos that are held out, in name order."""
        return tuple(v for v in self.views if v.split == "test")


def observations_of(
    observations: Int[Tensor, "T 2"], names: Sequence[str], views: Sequence[View]
) -> Int[Tensor, "U 2"]:
    """Observations by rows of `names` as observations by rows of `views`; those of other photos are left out."""
    rows = {view.name: row for row, view in enumerate(views)}
    row_of = torch.tensor([rows.get(name, -1) for name in names], dtype=torch.int32)
    moved = torch.stack([row_of[observations[:, 0].long()], observations[:, 1]], dim=1)
    return moved[moved[:, 0] >= 0]


def observed_pixels(
    scene: Scene, least_photos: int = LEAST_PHOTOS, split: Split = "train"
) -> dict[str, Float[Tensor, "K 2"]]:
    """Where photos show points that photos agree on, in pixels (x, y) by the photo's name.

    Args:
        scene: With observations.
        least_photos: Points that fewer photos triangulated are left out.
        split: Which photos.
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
    """The radius of the cameras that train, in world units: by which 3DGS scales steps and splits.

    1.1 times the largest distance of a camera from the cameras' mean, as in 3DGS. Cameras that share one
    place say nothing about the scene's size; then the median distance of the points from them counts.

    Raises:
        ValueError: The scene has no view that trains.
    """
    if not scene.train_views:
        raise ValueError("a scene without training views has no extent")
    positions = torch.stack([view.camera.position for view in scene.train_views])
    centre = positions.mean(dim=0)
    radius = float((positions - centre).norm(dim=-1).max())
    distance = float((scene.points - centre).norm(dim=-1).median()) if len(scene.points) else 1.0
    return 1.1 * (radius if radius > 1e-3 * distance else distance)


def find_view(scene: Scene, name: str) -> View:
    """The view of a photo by its name, or its name without the ending.

    Raises:
        UserError: The scene has no such photo.
    """
    view = match_view(scene.views, name)
    if view is None:
        raise UserError(
            f"{scene.root} has no photo {name!r} with a camera; names are as in its images/ folder"
        )
    return view


def match_view(views: Sequence[View], name: str) -> View | None:
    """The view of a photo by its name, or its name without the ending; None where there is none."""
    for view in views:
        if name in (view.name, str(Path(view.name).with_suffix(""))):
            return view
    return None
