"""The page is one file that asks nobody for anything, whatever its photos are called."""

from __future__ import annotations

import json
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
import torch

from wildgs.exporters import page as page_module
from wildgs.exporters.page import Page, PageLight, PageView, write_page
from wildgs.exporters.splats import Splats
from wildgs.geometry.camera import Camera

HOSTILE = """</script><script>alert("x")</script>'"&$title.jpg"""


class Elements(HTMLParser):
    """Attributes and text of all elements."""

    def __init__(self, file: Path) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.texts: dict[str, str] = {}
        self.feed(file.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        key = self.found[-1][1].get("id") or self.found[-1][0] if self.found else ""
        self.texts[key] = self.texts.get(key, "") + data


@pytest.fixture
def page(splats: Splats) -> Page:
    viewmat = torch.eye(4)
    viewmat[2, 3] = 4.0
    K = torch.tensor([[100.0, 0, 60], [0, 100, 40], [0, 0, 1]])
    lights = [
        PageLight(name, splats.sh + shift, np.full((30, 50, 3), 90, np.uint8))
        for name, shift in ((HOSTILE, 0.0), ("evening.jpg", 0.3))
    ]
    return Page(HOSTILE, "A <b>place</b>.", splats, lights, PageView(Camera(viewmat, K, 120, 80), 4.0), 0.05)


def test_hostile_names_stay_text(page: Page, tmp_path: Path) -> None:
    file = tmp_path / "folder" / "page.html"
    write_page(page, file)
    elements = Elements(file)
    assert [tag for tag, _ in elements.found].count("script") == 4
    assert elements.texts["h1"].strip() == elements.texts["title"].strip() == HOSTILE
    header = json.loads(elements.texts["header"])
    assert [light["name"] for light in header["lights"]] == [HOSTILE, "evening.jpg"]
    assert [path.name for path in file.parent.iterdir()] == ["page.html"]


def test_nothing_is_loaded_from_elsewhere(page: Page, tmp_path: Path) -> None:
    write_page(page, tmp_path / "page.html")
    for _, attributes in Elements(tmp_path / "page.html").found:
        for name in ("src", "href", "srcset", "action", "data"):
            assert (attributes.get(name) or "data:").startswith("data:")
    style = Elements(tmp_path / "page.html").texts["style"]
    assert "url(" not in style
    assert "@import" not in style


def test_the_page_carries_the_licences_of_what_is_in_it(page: Page, tmp_path: Path) -> None:
    write_page(page, tmp_path / "page.html")
    text = Elements(tmp_path / "page.html").texts["pre"]
    for name in ("@sparkjsdev/spark", "three", "fflate"):
        assert re.search(rf"^{name} \d+\.\d+\.\d+ \(MIT\)$", text, re.MULTILINE)
    assert text.count("Permission is hereby granted") == 3


def test_the_start_looks_through_the_camera(page: Page, tmp_path: Path) -> None:
    write_page(page, tmp_path / "page.html")
    start = json.loads(Elements(tmp_path / "page.html").texts["header"])["start"]
    assert start["position"] == pytest.approx([0, 0, -4])
    assert start["target"] == pytest.approx([0, 0, 0])
    assert start["aspect"] == pytest.approx(1.5)
    assert start["fov_y"] == pytest.approx(2 * np.arctan(0.4))


def test_degrees_are_given_up_until_the_page_fits(
    page: Page, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "page.html"
    assert write_page(page, file) == 3
    whole = file.stat().st_size
    monkeypatch.setattr(page_module, "BUDGET_BYTES", whole - 1)
    assert write_page(page, file, viewpoints=torch.zeros(1, 3)) == 2
    assert file.stat().st_size < whole
    assert write_page(page, file, sh_degree=1) == 1
