"""Views whose photos are in memory."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import UInt8

from wildgs.errors import UserError
from wildgs.geometry.camera import Camera
from wildgs.scene import View
from wildgs.scene.images import Photo
from wildgs.scene.photo_store import PhotoStore


@dataclass
class MemoryPhotos(PhotoStore):
    """Photos that are in memory already.

    Attributes:
        photos: By name.
        clean: Photos without their transients, by name.
        truth_masks: True masks, by name.
    """

    photos: dict[str, Photo] = field(default_factory=dict)
    clean: dict[str, UInt8[np.ndarray, "_ _ 3"]] = field(default_factory=dict)
    truth_masks: dict[str, UInt8[np.ndarray, "_ _"]] = field(default_factory=dict)

    def get(self, name: str) -> Photo:
        return self.photos[name]

    def read_clean(self, name: str) -> UInt8[np.ndarray, "H W 3"] | None:
        return self.clean.get(name)

    def read_truth_mask(self, name: str) -> UInt8[np.ndarray, "H W"] | None:
        return self.truth_masks.get(name)


def make_view(
    name: str,
    camera: Camera,
    split="train",
    photo: torch.Tensor | None = None,
    *,
    mask: torch.Tensor | None = None,
    disparity: torch.Tensor | None = None,
    clean: torch.Tensor | None = None,
    truth_mask: torch.Tensor | None = None,
) -> View:
    """A view; without `photo` it is black. Disparities above 1 are scaled to 1: their scale says nothing."""
    if photo is None:
        photo = torch.zeros(camera.height, camera.width, 3, dtype=torch.uint8)
    codes = None
    if disparity is not None:
        codes = (disparity / disparity.max().clamp_min(1) * 65535).round().numpy().astype(np.uint16)
    store = MemoryPhotos({name: Photo(photo.numpy(), None if mask is None else mask.numpy(), codes)})
    if clean is not None:
        store.clean[name] = clean.numpy()
    if truth_mask is not None:
        store.truth_masks[name] = truth_mask.numpy()
    return View(name, camera, split, store)


def with_photos(view: View, **arrays) -> View:
    """The view with other arrays of its `Photo`."""
    photo = replace(view.photos.get(view.name), **arrays)
    return replace(view, photos=MemoryPhotos({view.name: photo}))


class GonePhotos(PhotoStore):
    """A store whose photos cannot be read any more."""

    def get(self, name: str) -> Photo:
        raise UserError(f"images/{name}: no such file; restore or replace the photo")
