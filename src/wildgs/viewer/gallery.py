"""Thumbnails of photos and masks over them, computed a few at a time."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image
from torch import Tensor

from wildgs.errors import UserError
from wildgs.exporters.depth_colors import tint_hidden
from wildgs.scene import View
from wildgs.viewer.markup import jpeg_uri, thumbnail

AT_ONCE = 4
"""Number of photos per call, since other jobs wait for the same thread."""


def spread(views: Sequence[View], count: int) -> tuple[View, ...]:
    """An even selection of at most `count` views."""
    count = min(count, len(views))
    return tuple(views[index * len(views) // count] for index in range(count))


class Gallery:
    """Thumbnails of some photos, by name.

    Attributes:
        masks: Whether thumbnails show in red what the mask M hides.
    """

    def __init__(self, views: Sequence[View]) -> None:
        self.views = tuple(views)
        self.names = tuple(view.name for view in views)
        self._pictures: dict[str, UInt8[np.ndarray, "h w 3"]] = {}
        self._sources: dict[str, str] = {}
        self._masked: dict[str, tuple[UInt8[np.ndarray, "h w 3"], str]] = {}
        self.masks = False
        self._waiting, self._unmasked = list(self.views), list[View]()
        self._listeners: list[Callable[[], None]] = []

    def on_change(self, listener: Callable[[], None]) -> None:
        """Registers a function that is called whenever thumbnails are added."""
        self._listeners.append(listener)

    def load_some(self) -> bool:
        """Decodes the next few photos, skipping unreadable ones; returns whether photos are left."""
        chosen, self._waiting = self._waiting[:AT_ONCE], self._waiting[AT_ONCE:]
        for view in chosen:
            try:
                picture = thumbnail(view.read_photo())
            except UserError:
                continue
            self._pictures[view.name] = picture
            self._sources[view.name] = jpeg_uri(picture, quality=75)
        if chosen:
            self._announce()
        return bool(self._waiting)

    def show_masks(self, shown: bool) -> None:
        """Shows photos with or without masks, which `mask_some` computes."""
        self.masks = shown
        self._unmasked = list(self.views) if shown else []
        self._announce()

    def mask_some(self, visibility: Callable[[View], Float[Tensor, "_ _"] | None]) -> bool:
        """Computes the next few thumbnails with masks; returns whether photos are left.

        Args:
            visibility: Returns the mask M of a photo, 1 = static.

        Raises:
            UserError: The method predicts no masks.
        """
        chosen, self._unmasked = self._unmasked[:AT_ONCE], self._unmasked[AT_ONCE:]
        for view in chosen:
            picture = self._pictures.get(view.name)
            if picture is None:
                continue
            mask = visibility(view)
            if mask is None:
                self.show_masks(False)
                raise UserError("this method predicts no masks")
            size = (picture.shape[1], picture.shape[0])
            small = np.asarray(Image.fromarray(mask.numpy()).resize(size, Image.Resampling.BOX))
            tinted = tint_hidden(picture, small)
            self._masked[view.name] = tinted, jpeg_uri(tinted, quality=75)
        if chosen:
            self._announce()
        return bool(self._unmasked)

    def _announce(self) -> None:
        for listener in self._listeners:
            listener()

    def sources(self) -> list[tuple[str, str]]:
        """Name and data URI of every loaded thumbnail."""
        masked = self._masked if self.masks else {}
        return [(name, masked[name][1] if name in masked else uri) for name, uri in self._sources.items()]

    def picture(self, name: str) -> UInt8[np.ndarray, "h w 3"] | None:
        """A photo's thumbnail; None if it is not loaded yet."""
        return self._masked[name][0] if self.masks and name in self._masked else self._pictures.get(name)

    def mean_colors(self) -> dict[str, np.ndarray]:
        """Mean RGB of every loaded thumbnail."""
        return {name: picture.reshape(-1, 3).mean(axis=0) for name, picture in self._pictures.items()}
