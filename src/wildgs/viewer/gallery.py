"""The photos that are offered at a glance: thumbnails, decoded a few at a time."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import UInt8

from wildgs.errors import UserError
from wildgs.scene import View
from wildgs.viewer.markup import jpeg_uri, thumbnail

AT_ONCE = 4
"""Photos decoded in one go: others wait for the same thread."""


def spread(views: Sequence[View], count: int) -> tuple[View, ...]:
    """At most `count` views, evenly spread over their names."""
    count = min(count, len(views))
    return tuple(views[index * len(views) // count] for index in range(count))


class Gallery:
    """Thumbnails of some photos, by name."""

    def __init__(self, views: Sequence[View]) -> None:
        self.views = tuple(views)
        self.names = tuple(view.name for view in views)
        self._pictures: dict[str, UInt8[np.ndarray, "h w 3"]] = {}
        self._sources: dict[str, str] = {}
        self._waiting = list(self.views)
        self._listeners: list[Callable[[], None]] = []

    def on_change(self, listener: Callable[[], None]) -> None:
        """Calls a function whenever thumbnails were added."""
        self._listeners.append(listener)

    def load_some(self) -> bool:
        """Decodes the next few photos; False once there is nothing left. Photos that do not open are left out."""
        chosen, self._waiting = self._waiting[:AT_ONCE], self._waiting[AT_ONCE:]
        for view in chosen:
            try:
                picture = thumbnail(view.read_photo())
            except UserError:
                continue
            self._pictures[view.name] = picture
            self._sources[view.name] = jpeg_uri(picture, quality=75)
        if chosen:
            for listener in self._listeners:
                listener()
        return bool(self._waiting)

    def sources(self) -> list[tuple[str, str]]:
        """Name and data URI of every thumbnail there is."""
        return list(self._sources.items())

    def picture(self, name: str) -> UInt8[np.ndarray, "h w 3"] | None:
        """A photo's thumbnail, where there is one yet."""
        return self._pictures.get(name)

    def mean_colors(self) -> dict[str, np.ndarray]:
        """Mean RGB of every thumbnail there is."""
        return {name: picture.reshape(-1, 3).mean(axis=0) for name, picture in self._pictures.items()}
