"""The light controls: two photos or uploaded images, and a slider that interpolates between them."""

from __future__ import annotations

import math
import re
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from wildgs.errors import UserError
from wildgs.files import printable, written_aside
from wildgs.light.look import Look, mix
from wildgs.scene.images import UnreadableImageError, read_photo
from wildgs.viewer.gallery import Gallery
from wildgs.viewer.markup import (
    Thumbnail,
    chosen_frames,
    contact_sheet,
    drop_zone,
    element_id,
    light_pair,
)
from wildgs.viewer.subject import Subject

if TYPE_CHECKING:
    import viser

    from wildgs.viewer.guarded import GuardedServer

MAX_UPLOAD_PIXELS = 50_000_000
"""Largest uploaded image; a file of a few hundred kB can contain hundreds of megapixels."""
UPLOAD_SIDE = 2048
"""Longest side to which uploaded images are reduced; their embedding needs much less."""
KEPT_UPLOADS = 16
"""Number of uploaded images that are kept; older ones are deleted."""
SIDES = ("Left", "Right")
"""Ends of the slider; a click on a photo assigns its light to the selected end."""


@dataclass(frozen=True)
class Light:
    """A light: arguments of `LightSources.find`, and a label."""

    spec: str
    label: str
    like: str | None = None


@dataclass(frozen=True)
class LightDesk:
    """Two lights and the position of the slider between them: 0 is the first, 1 the second."""

    first: Light
    second: Light
    amount: float = 0.0

    def with_light(self, light: Light, side: str) -> LightDesk:
        """Replaces the light on one side and moves the slider there."""
        if side == SIDES[0]:
            return replace(self, first=light, amount=0.0)
        return replace(self, second=light, amount=1.0)

    @classmethod
    def at_hour(cls, day: Sequence[str], share: float) -> LightDesk:
        """Two neighbouring photos of a day (at least two photos, in order) at a fraction of it."""
        position = min(max(share, 0.0), 1.0) * (len(day) - 1)
        index = min(int(position), len(day) - 2)
        before, after = (Light(name, name) for name in day[index : index + 2])
        return cls(before, after, position - index)

    def look(self, subject: Subject) -> Look:
        """The mixed light; embeds only the photos that it depends on.

        Raises:
            UserError: A light cannot be obtained.
        """
        if self.amount <= 0:
            return subject.look(self.first.spec, self.first.like)
        if self.amount >= 1:
            return subject.look(self.second.spec, self.second.like)
        looks = [subject.look(light.spec, light.like) for light in (self.first, self.second)]
        return mix(looks, [1 - self.amount, self.amount])


class LightPanel:
    """The controls of a `LightDesk`."""

    def __init__(
        self,
        server: GuardedServer,
        desk: LightDesk,
        gallery: Gallery,
        changed: Callable[[], None],
        lender: Callable[[], str],
        masks_asked: Callable[[bool], None],
        day: Sequence[str] = (),
    ) -> None:
        """Adds the controls to the open container.

        Args:
            server: The viewer's server.
            desk: The initial lights.
            gallery: Photos to choose from.
            changed: Called on a thread of viser after the desk changed.
            lender: Returns the name of the photo whose camera and depth an uploaded image uses.
            masks_asked: Called on a thread of viser when masks over the photos are switched on or off.
            day: Names of the photos of a day, in order; empty if the day is not known.
        """
        self.desk = desk
        self._server, self._gallery = server, gallery
        self._changed, self._lender = changed, lender
        self._uploads = tempfile.TemporaryDirectory(prefix="wildgs-view-")
        self._number = 0
        self.touched = False
        gui = server.gui
        self._side = gui.add_button_group(
            "Assign photo to", SIDES, hint="End of the slider that a click on a photo changes"
        )
        self._sheet = gui.add_html("")
        self._buttons = {name: self._add_button(name) for name in gallery.names}
        self.masks = gui.add_checkbox(
            "Show masks",
            gallery.masks,
            hint="Red areas of a photo, such as passers-by, are hidden by its mask",
        )
        self.masks.on_update(lambda _: masks_asked(self.masks.value))
        self._slider = gui.add_slider("Mix", 0.0, 1.0, 0.01, desk.amount)
        if len(day) > 1:
            self._hour = gui.add_slider(
                "Day", 0.0, 1.0, 0.002, 0.0, hint="Time of day, from the first photo to the last"
            )
            self._hour.on_update(lambda _: self.set_hour(day, self._hour.value))
        self._frames = gui.add_html("")
        self._pair = gui.add_html("")
        self._upload = gui.add_upload_button("Upload an image", mime_type="image/*")
        gui.add_html(drop_zone(element_id(self._upload)))
        self._slider.on_update(lambda _: self.set_amount(self._slider.value))
        server.uploads.receive(element_id(self._upload), self.take_picture)
        gallery.on_change(self._draw_thumbnails)
        self._draw_thumbnails()
        self._refresh()

    def _add_button(self, name: str) -> viser.GuiButtonHandle:
        button = self._server.gui.add_button(printable(name))
        button.on_click(lambda _: self.choose(Light(name, name)))
        return button

    def choose(self, light: Light) -> None:
        """Assigns a light to the selected side."""
        self.touched = True
        self._set(self.desk.with_light(light, self._side.value))

    def suggest(self, first: str, second: str) -> None:
        """Sets the lights of two photos, unless a user has changed them already."""
        if not self.touched:
            self._set(LightDesk(Light(first, first), Light(second, second)))

    def set_amount(self, amount: float) -> None:
        """Sets the position of the slider."""
        if math.isfinite(amount) and amount != self.desk.amount:
            self.touched = True
            self._set(replace(self.desk, amount=min(max(float(amount), 0.0), 1.0)))

    def set_hour(self, day: Sequence[str], share: float) -> None:
        """Sets the time of day."""
        if math.isfinite(share):
            self.touched = True
            self._set(LightDesk.at_hour(day, share))

    def take_picture(self, name: str, content: bytes) -> None:
        """Assigns the light of an uploaded image to the selected side; `UserError` if it cannot be used."""
        self._number += 1
        folder = Path(self._uploads.name)
        file = store_upload(folder, self._number, name, content)
        used = {self.desk.first.spec, self.desk.second.spec}
        kept = sorted(folder.iterdir(), key=lambda path: path.stat().st_mtime)[:-KEPT_UPLOADS]
        for old in kept:
            if str(old) not in used:
                old.unlink(missing_ok=True)
        self.choose(Light(str(file), name, self._lender()))

    def _set(self, desk: LightDesk) -> None:
        self.desk = desk
        if self._slider.value != desk.amount:
            self._slider.value = desk.amount
        self._refresh()
        self._changed()

    def take_back(self, desk: LightDesk) -> None:
        """Restores an earlier desk after a light could not be obtained."""
        self.desk = desk
        self._slider.value = desk.amount
        self._refresh()

    def _draw_thumbnails(self) -> None:
        self._sheet.content = contact_sheet(
            [
                Thumbnail(name, source, element_id(self._buttons[name]))
                for name, source in self._gallery.sources()
            ]
        )

    def _refresh(self) -> None:
        """Shows which lights are selected and their weights."""
        desk = self.desk
        buttons = [self._buttons.get(light.spec) for light in (desk.first, desk.second)]
        self._frames.content = chosen_frames(
            [None if button is None else element_id(button) for button in buttons]
        )
        self._pair.content = light_pair(desk.first.label, desk.second.label, desk.amount)

    def close(self) -> None:
        """Deletes uploaded images."""
        self._uploads.cleanup()


def store_upload(folder: Path, number: int, name: str, content: bytes) -> Path:
    """Decodes an uploaded image and writes it, reduced, to a folder under a safe and unique name.

    Raises:
        UserError: The image cannot be read or stored, or has too many pixels.
    """
    stem = re.sub(r"[^A-Za-z0-9]+", "-", Path(name.replace("\\", "/")).stem).strip("-")[:40]
    received = folder / f"received-{number}"
    try:
        received.write_bytes(content)
        picture = Image.fromarray(read_photo(received, max_pixels=MAX_UPLOAD_PIXELS).pixels)
    except UnreadableImageError as error:
        raise UserError(str(error).replace(" (--max-image-pixels)", "")) from error
    except OSError as error:
        raise UserError(f"the image cannot be stored ({error.strerror}); free disk space") from error
    finally:
        received.unlink(missing_ok=True)
    picture.thumbnail((UPLOAD_SIDE, UPLOAD_SIDE), Image.Resampling.LANCZOS, reducing_gap=2.0)
    with written_aside(folder / f"{stem or 'picture'}-{number}.png") as aside:
        picture.save(aside, format="PNG", compress_level=1)
    return folder / f"{stem or 'picture'}-{number}.png"


def most_different(colors: dict[str, np.ndarray], start: str) -> str:
    """The photo whose mean colour is farthest from another's."""
    return max(colors, key=lambda name: float(np.linalg.norm(colors[name] - colors[start])))
