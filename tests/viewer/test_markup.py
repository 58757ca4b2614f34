"""Whatever a file is called, it stays text."""

from __future__ import annotations

import re
from html.parser import HTMLParser

import numpy as np
import pytest
import torch

from wildgs.viewer.markup import (
    CHOSEN_COLORS,
    Thumbnail,
    chosen_frames,
    contact_sheet,
    figures,
    light_pair,
    thumbnail,
)

NASTY = ["<script>alert(1)</script>", '" onclick="alert(1)', "' onmouseover='x", "</label><b>", "&lt;img&gt;"]
PICTURE = np.zeros((4, 6, 3), dtype=np.uint8)


class Tags(HTMLParser):
    """Tags, their attributes and the text of a page."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.attributes: dict[str, list[str | None]] = {}
        self.text = ""
        self.feed(page)

    def handle_starttag(self, tag: str, attrs) -> None:
        self.tags.append(tag)
        for name, value in attrs:
            self.attributes.setdefault(name, []).append(value)

    def handle_data(self, data: str) -> None:
        self.text += data


@pytest.mark.parametrize("name", NASTY)
def test_names_stay_text(name: str) -> None:
    pages = [
        contact_sheet([Thumbnail(name, "data:image/jpeg;base64,", "id")]),
        light_pair(name, name, 0.3),
        figures([(name, PICTURE)], name),
    ]
    for page in pages:
        seen = Tags(page)
        assert set(seen.tags) <= {"style", "div", "label", "img", "span", "figure", "figcaption"}
        assert not [attribute for attribute in seen.attributes if attribute.startswith("on")]
    assert Tags(pages[0]).attributes["title"] == [name]
    assert name in Tags(pages[1]).text
    assert name in Tags(pages[2]).text


def test_chosen_photos_have_their_light_s_frame() -> None:
    frames = re.findall(r'label\[for="(\w+)"\] img\{outline:3px solid ([^}]+)\}', chosen_frames(["b", "c"]))
    assert sorted(frames) == [("b", CHOSEN_COLORS[0]), ("c", CHOSEN_COLORS[1])]
    assert CHOSEN_COLORS[1] not in chosen_frames(["b", None])


def test_of_one_photo_for_both_lights_the_first_frame_is_seen() -> None:
    """The rule that comes last wins."""
    page = chosen_frames(["b", "b"])
    assert page.index(CHOSEN_COLORS[0]) > page.index(CHOSEN_COLORS[1])


def test_thumbnails_keep_their_shape() -> None:
    small = thumbnail(torch.zeros(300, 600, 3, dtype=torch.uint8), side=100)
    assert small.shape == (50, 100, 3)
