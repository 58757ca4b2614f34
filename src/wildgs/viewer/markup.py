"""HTML for viser's panels; file names are escaped here."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import UInt8
from PIL import Image
from torch import Tensor

from wildgs.files import printable

THUMBNAIL_SIDE = 96
CHOSEN_COLORS = ("#4dabf7", "#ffa94d")
"""Colours of the frames around the thumbnails of the first and the second light."""


@dataclass(frozen=True)
class Thumbnail:
    """A clickable photo: its name, a data URI, and the id of the button that a click triggers."""

    name: str
    source: str
    button: str


def escape(text: str) -> str:
    """Escapes text for HTML; unprintable characters become visible escapes."""
    return html.escape(printable(text), quote=True)


def element_id(handle: Any) -> str:
    """The id of a button's HTML element; viser has no public attribute for it."""
    return handle._impl.uuid


def jpeg_uri(picture: UInt8[np.ndarray, "H W 3"], quality: int = 85) -> str:
    """An image as a JPEG data URI."""
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, format="JPEG", quality=quality)
    return "data:image/jpeg;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")


def thumbnail(photo: UInt8[Tensor, "H W 3"], side: int = THUMBNAIL_SIDE) -> UInt8[np.ndarray, "h w 3"]:
    """The photo, reduced to a longer side of at most `side` pixels."""
    image = Image.fromarray(photo.numpy())
    image.thumbnail((side, side), Image.Resampling.BICUBIC, reducing_gap=2.0)
    return np.asarray(image).copy()


def contact_sheet(thumbnails: Sequence[Thumbnail]) -> str:
    """A grid of thumbnails; each is a label of a hidden button.

    A label forwards clicks without a script, so that names of photos cannot inject code.
    """
    hidden = ",".join(f'div:has(> [id="{thumb.button}"])' for thumb in thumbnails)
    cells = "".join(
        f'<label for="{escape(thumb.button)}" title="{escape(thumb.name)}" style="cursor:pointer;display:block;'
        f'line-height:0;padding:3px"><img src="{thumb.source}" alt="{escape(thumb.name)}" '
        'style="width:100%;height:56px;object-fit:cover;border-radius:3px"></label>'
        for thumb in thumbnails
    )
    return (
        f"<style>{hidden}{{display:none}}</style>"
        '<div style="display:grid;grid-template-columns:repeat(4,1fr);margin:4px 8px 8px;'
        f'max-height:260px;overflow-y:auto">{cells}</div>'
    )


def chosen_frames(buttons: Sequence[str | None]) -> str:
    """Frames around the thumbnails of the two lights, by the ids of their buttons (None without thumbnail).

    Separate from the grid, which would scroll back to the top whenever it is sent again.
    """
    rules = (
        f'label[for="{button}"] img{{outline:3px solid {color}}}'
        for button, color in reversed(list(zip(buttons, CHOSEN_COLORS, strict=True)))
        if button is not None
    )
    return f"<style>{''.join(rules)}</style>"


def light_pair(first: str, second: str, amount: float) -> str:
    """Names and weights of the two lights, in the colours of their frames."""
    names = (
        f'<span style="color:{color};overflow-wrap:anywhere">{escape(name)}</span>'
        for name, color in zip((first, second), CHOSEN_COLORS, strict=True)
    )
    left, right = names
    return (
        '<div style="display:flex;justify-content:space-between;gap:12px;font-size:12px;margin:0 12px 6px">'
        f"<div>{left} {100 * (1 - amount):.0f}%</div>"
        f'<div style="text-align:right">{right} {100 * amount:.0f}%</div></div>'
    )


def figures(pictures: Sequence[tuple[str, UInt8[np.ndarray, "_ _ 3"]]], note: str) -> str:
    """Images with captions in two columns, and a note below."""
    cells = "".join(
        '<figure style="margin:0"><img style="width:100%;display:block;border-radius:4px" '
        f'src="{jpeg_uri(picture)}" alt="{escape(caption)}">'
        f'<figcaption style="font-size:12px;opacity:.75;padding:2px 0 4px">{escape(caption)}</figcaption></figure>'
        for caption, picture in pictures
    )
    return (
        '<div style="display:grid;grid-template-columns:1fr 1fr;gap:6px;margin:6px 10px 0">'
        f'{cells}</div><div style="font-size:12px;margin:2px 12px 8px;overflow-wrap:anywhere">{escape(note)}</div>'
    )


def drop_zone(upload_button: str) -> str:
    """Shows the file input of viser's upload button (its id) as an area where files can be dropped."""
    return (
        f'<style>[id="file_upload_{upload_button}"]{{display:block !important;box-sizing:border-box;width:100%;'
        "padding:18px 10px;margin-bottom:6px;border:1.5px dashed #868e96;border-radius:6px;font-size:12px;"
        f'color:inherit}}[id="{upload_button}"]{{display:none}}</style>'
        '<div style="font-size:12px;opacity:.75;margin:2px 12px">Drop any image here to light the scene like it</'
        "div>"
    )
