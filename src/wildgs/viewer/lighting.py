"""The light: two photos (or pictures), and a slider between them."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from wildgs.errors import UserError
from wildgs.light.look import Look, mix
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

MAX_UPLOAD_BYTES = 64 * 2**20
SIDES = ("Left", "Right")
"""Ends of the slider: a click on a photo gives its light to the chosen one."""


@dataclass(frozen=True)
class Light:
    """Where a light comes from.

    Attributes:
        spec: A photo of the scene by name, or any other spec of `wildgs.light.sources`.
        label: For people.
        like: Whose camera a picture borrows.
    """

    spec: str
    label: str
    like: str | None = None


@dataclass(frozen=True)
class LightDesk:
    """Two lights and where the slider between them stands.

    Attributes:
        first: At amount 0.
        second: At amount 1.
        amount: In [0, 1].
    """

    first: Light
    second: Light
    amount: float = 0.0

    def with_light(self, light: Light, side: str) -> LightDesk:
        """The desk with another light on one side, the slider moved there: who chooses a light wants to see it."""
        if side == SIDES[0]:
            return replace(self, first=light, amount=0.0)
        return replace(self, second=light, amount=1.0)

    def look(self, subject: Subject) -> Look:
        """The light as it is mixed; encodes a photo only when its light is needed.

        Raises:
            UserError: A light cannot be found.
        """
        if self.amount <= 0:
            return subject.look(self.first.spec, self.first.like)
        if self.amount >= 1:
            return subject.look(self.second.spec, self.second.like)
        looks = [subject.look(light.spec, light.like) for light in (self.first, self.second)]
        return mix(looks, [1 - self.amount, self.amount])


class LightPanel:
    """The controls of a desk."""

    def __init__(
        self,
        server: viser.ViserServer,
        desk: LightDesk,
        gallery: Gallery,
        changed: Callable[[], None],
        complain: Callable[[str], None],
        lender: Callable[[], str],
    ) -> None:
        """Adds the controls to the container that is open.

        Args:
            server: The viewer's.
            desk: How it begins.
            gallery: Photos to choose from.
            changed: Called, on a thread of viser's, after the desk changed.
            complain: Called with one line for a picture that cannot be used.
            lender: Names the photo whose camera a picture borrows.
        """
        self.desk = desk
        self._server, self._gallery = server, gallery
        self._changed, self._complain, self._lender = changed, complain, lender
        self._uploads = tempfile.TemporaryDirectory(prefix="wildgs-view-")
        self._number = 0
        self.touched = False
        gui = server.gui
        self._side = gui.add_button_group(
            "Photo goes", SIDES, hint="Which end of the slider a photo is given to"
        )
        self._sheet = gui.add_html("")
        self._buttons = {name: self._add_button(name) for name in gallery.names}
        self._slider = gui.add_slider("Mix", 0.0, 1.0, 0.01, desk.amount)
        self._frames = gui.add_html("")
        self._pair = gui.add_html("")
        self._upload = gui.add_upload_button("A picture of your own", mime_type="image/*")
        gui.add_html(drop_zone(element_id(self._upload)))
        self._slider.on_update(lambda _: self.set_amount(self._slider.value))
        self._upload.on_upload(
            lambda _: self.take_picture(self._upload.value.name, self._upload.value.content)
        )
        gallery.on_change(self._draw_thumbnails)
        self._draw_thumbnails()
        self._refresh()

    def _add_button(self, name: str) -> viser.GuiButtonHandle:
        button = self._server.gui.add_button(name)
        button.on_click(lambda _: self.choose(Light(name, name)))
        return button

    def choose(self, light: Light) -> None:
        """Gives a light to the side that is chosen."""
        self.touched = True
        self._set(self.desk.with_light(light, self._side.value))

    def suggest(self, first: str, second: str) -> None:
        """Takes two photos' lights, unless someone has chosen already."""
        if not self.touched:
            self._set(LightDesk(Light(first, first), Light(second, second)))

    def set_amount(self, amount: float) -> None:
        """Moves along the slider."""
        if amount != self.desk.amount:
            self.touched = True
            self._set(replace(self.desk, amount=float(amount)))

    def take_picture(self, name: str, content: bytes) -> None:
        """Lights the scene like a picture that a browser sent."""
        if len(content) > MAX_UPLOAD_BYTES:
            self._complain(f"{name}: pictures may have up to {MAX_UPLOAD_BYTES // 2**20} MB")
            return
        self._number += 1
        try:
            file = store_upload(Path(self._uploads.name), self._number, name, content)
        except UserError as error:
            self._complain(str(error))
            return
        self.choose(Light(str(file), name, self._lender()))

    def _set(self, desk: LightDesk) -> None:
        self.desk = desk
        if self._slider.value != desk.amount:
            self._slider.value = desk.amount
        self._refresh()
        self._changed()

    def take_back(self, desk: LightDesk) -> None:
        """Stands as before: a light could not be found."""
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
        """Shows which lights are chosen, and how much of each."""
        desk = self.desk
        buttons = [self._buttons.get(light.spec) for light in (desk.first, desk.second)]
        self._frames.content = chosen_frames(
            [None if button is None else element_id(button) for button in buttons]
        )
        self._pair.content = light_pair(desk.first.label, desk.second.label, desk.amount)

    def close(self) -> None:
        """Deletes uploaded pictures."""
        self._uploads.cleanup()


def store_upload(folder: Path, number: int, name: str, content: bytes) -> Path:
    """Writes what a browser sent under a name of ours: of its own only letters and digits are kept.

    Raises:
        UserError: It is empty.
    """
    if not content:
        raise UserError(f"{name}: the picture is empty")
    stem = re.sub(r"[^A-Za-z0-9]+", "-", Path(name.replace("\\", "/")).stem).strip("-")[:40]
    file = folder / f"{stem or 'picture'}-{number}.img"
    file.write_bytes(content)
    return file


def most_different(colors: dict[str, np.ndarray], start: str) -> str:
    """The photo whose mean colour is farthest from another's."""
    return max(colors, key=lambda name: float(np.linalg.norm(colors[name] - colors[start])))
