"""The report is one self-contained page that says what it was given."""

from __future__ import annotations

import base64
import io
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from wildgs.exporters.depth_colors import color_depth
from wildgs.exporters.report import (
    MethodScores,
    Report,
    ReportExample,
    ReportMask,
    ReportUnplaced,
    write_report,
)

HOSTILE = """<script>alert("x")</script>'"&.jpg"""
REASON = "LPIPS is null: its weights are not at hand"


class Page(HTMLParser):
    """Collects elements and text."""

    def __init__(self, file: Path) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.text: list[str] = []
        self.open: list[str] = []
        self.feed(file.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        if tag not in ("img", "meta", "input"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if data.strip():
            self.text.append(data.strip())

    def pictures(self) -> list[tuple[dict[str, str | None], Image.Image]]:
        found = []
        for tag, attributes in self.elements:
            if tag == "img":
                kind, data = str(attributes["src"]).split(",")
                assert kind == "data:image/jpeg;base64"
                image = Image.open(io.BytesIO(base64.b64decode(data, validate=True)))
                image.load()
                found.append((attributes, image))
        return found


def _flat(height: int, width: int, color: tuple[int, int, int]) -> np.ndarray:
    return np.full((height, width, 3), color, dtype=np.uint8)


def _example(name: str = "a.jpg", height: int = 24, width: int = 32, **more) -> ReportExample:
    mask = np.full((height, width), 255, dtype=np.uint8)
    mask[: height // 2] = 0
    depth = np.full((height, width), 5.0)
    return ReportExample(
        name, _flat(height, width, (200, 30, 30)), _flat(height, width, (30, 200, 30)), mask, depth, **more
    )


def _metrics(psnr: float, lpips: float | None) -> dict:
    return {
        "protocol": "full",
        "step": 1500,
        "num_gaussians": 41234,
        "train_seconds": 90.0,
        "render_fps": 30.04,
        "device": "cpu",
        "mean": {"psnr": psnr, "ssim": 0.8125, "lpips": lpips},
        "images": [],
        "notes": [REASON] if lpips is None else [],
    }


def _write(tmp_path: Path, *examples: ReportExample, methods: tuple[MethodScores, ...] = ()) -> Page:
    file = tmp_path / "deep" / "report.html"
    write_report(Report("A title", "A summary", methods, examples), file)
    assert [path.name for path in file.parent.iterdir()] == ["report.html"]
    return Page(file)


def test_every_picture_is_inside_the_page_with_its_own_pixels_and_says_what_it_shows(tmp_path: Path) -> None:
    relit = (("b.jpg", _flat(300, 200, (9, 9, 200)), _flat(24, 32, (120, 120, 9))),)
    clean, baseline = _flat(24, 32, (250, 250, 250)), _flat(24, 32, (10, 10, 10))
    page = _write(tmp_path, _example(relit=relit, clean=clean, baseline=baseline))
    pictures = page.pictures()
    assert all(attributes["alt"] for attributes, _ in pictures)
    by_color = {str(a["alt"]): np.asarray(image)[-1, -1].tolist() for a, image in pictures}
    for alt, color in {
        "Photo a.jpg": (200, 30, 30),
        "Render of a.jpg under its own appearance": (30, 200, 30),
        "Visibility mask of a.jpg": (255, 255, 255),
        "a.jpg without transients": (250, 250, 250),
        "a.jpg rendered by 3DGS": (10, 10, 10),
        "a.jpg rendered under the appearance of b.jpg": (120, 120, 9),
        "Photo b.jpg, the source of the appearance": (9, 9, 200),
    }.items():
        np.testing.assert_allclose(by_color[alt], color, atol=4)
    assert len(pictures) == 8
    assert max(pictures[-1][1].size) == 160, "a source photo is shown small"


def test_training_photos_stand_beside_their_masks(tmp_path: Path) -> None:
    visibility = np.ones((300, 600), dtype=np.float32)
    visibility[:, :300] = 0
    masks = (ReportMask("b.jpg", _flat(300, 600, (200, 200, 200)), visibility, "3.0% hidden"),)
    misfits = (ReportMask(HOSTILE, _flat(30, 20, (9, 9, 200)), None, "5.0 dB"),)
    file = tmp_path / "report.html"
    write_report(Report("A title", "A summary", misfits=misfits, masks=masks), file)
    page = Page(file)
    pictures = {str(attributes["alt"]): np.asarray(image) for attributes, image in page.pictures()}
    hidden = pictures["What the mask of b.jpg hides"]
    assert hidden.shape == (120, 240, 3), "shown small"
    assert hidden[60, 30, 0] > 150 > 100 > hidden[60, 30, 1]
    np.testing.assert_allclose(hidden[60, 210], 200, atol=4)
    np.testing.assert_allclose(pictures[f"Training photo {HOSTILE}"][5, 5], (9, 9, 200), atol=8)
    assert len(pictures) == 3
    assert page.text.index("Misfits") < page.text.index("Masks of training photos")
    assert not page.open


def test_nothing_is_loaded_from_elsewhere(tmp_path: Path) -> None:
    page = _write(tmp_path, _example())
    for tag, attributes in page.elements:
        assert tag not in ("link", "iframe", "object", "embed")
        assert not (tag == "script" and "src" in attributes)
        assert "href" not in attributes
    source = (tmp_path / "deep" / "report.html").read_text()
    assert "url(" not in source
    assert "http:" not in source
    assert "https:" not in source
    assert not page.open, "every element is closed"


def test_hostile_names_stay_text(tmp_path: Path) -> None:
    relit = ((HOSTILE, _flat(8, 8, (1, 2, 3)), _flat(24, 32, (4, 5, 6))),)
    example = _example(HOSTILE, relit=relit, baseline=_flat(24, 32, (0, 0, 0)), baseline_name=HOSTILE)
    method = MethodScores(HOSTILE, {"full": {"psnr": 20.0}}, device=HOSTILE, notes=(HOSTILE,))
    file = tmp_path / "report.html"
    write_report(Report(HOSTILE, HOSTILE + " $title ${x}", (method,), (example,)), file)
    page = Page(file)
    assert [tag for tag, _ in page.elements].count("script") == 1
    assert not any(name.startswith("on") for _, attributes in page.elements for name in attributes)
    assert page.text.count(HOSTILE) >= 4
    assert HOSTILE + " $title ${x}" in page.text
    assert f"Photo {HOSTILE}" in [attributes.get("alt") for _, attributes in page.elements]


def test_scores_are_shown_and_a_missing_one_comes_with_its_reason(tmp_path: Path) -> None:
    wild = MethodScores.from_metrics(
        "Wild-GS", {"full": _metrics(23.456, None), "half": _metrics(21.0, 0.25)}
    )
    base = MethodScores.from_metrics("3DGS", {"full": _metrics(16.1, None)}, steps=700)
    page = _write(tmp_path, methods=(wild, base))
    for shown in ("23.46", "0.812", "21.00", "0.250", "16.10", "1,500", "700", "1.5", "41,234", "30.0"):
        assert shown in page.text
    assert page.text.count(REASON) == 1
    missing = [a for tag, a in page.elements if tag == "span" and "not computed" in str(a.get("aria-label"))]
    assert len(missing) == 2 + 3  # LPIPS twice; the baseline was not scored in protocol half
    best = [a for tag, a in page.elements if tag == "td" and "best" in str(a.get("class")).split()]
    assert len(best) == 1 + 2, "PSNR of the better one, SSIM of both, as they are equal"


def test_a_note_that_concerns_one_method_names_it(tmp_path: Path) -> None:
    first = MethodScores("A", {"full": {"psnr": 1.0}}, notes=("slow",))
    page = _write(tmp_path, methods=(first, MethodScores("B", {"full": {"psnr": 2.0}})))
    assert "A: slow" in page.text


@pytest.mark.parametrize(
    ("notes", "lines"), [(None, ()), ("one", ("one",)), ({"lpips": "why"}, ("lpips: why",)), (["x"], ("x",))]
)
def test_notes_are_read_in_whatever_form_they_come(notes: object, lines: tuple[str, ...]) -> None:
    metrics = {**_metrics(20.0, 0.1), "notes": notes}
    assert MethodScores.from_metrics("A", {"full": metrics, "half": metrics}).notes == lines


def test_a_report_without_scores_views_or_other_lights_is_still_a_page(tmp_path: Path) -> None:
    assert "A summary" in _write(tmp_path).text
    page = _write(tmp_path, _example(height=32, width=24))
    assert len(page.pictures()) == 4
    assert not any("appearance of other photos" in text for text in page.text)


def test_a_second_report_replaces_the_first(tmp_path: Path) -> None:
    for title in ("old", "new"):
        write_report(Report(title, ""), tmp_path / "report.html")
    assert "new" in Page(tmp_path / "report.html").text
    assert "old" not in Page(tmp_path / "report.html").text


def test_near_is_bright_far_is_dark_and_no_depth_is_grey() -> None:
    depth = np.geomspace(1.0, 50.0, 200).reshape(10, 20)
    depth[0, 0], depth[0, 1] = 0.0, np.inf
    picture = color_depth(depth).astype(int)
    brightness = picture.sum(axis=2).ravel()[2:]
    assert (np.diff(brightness) <= 0).mean() > 0.97
    assert brightness[0] > brightness[-1] + 300
    assert picture[0, 0].tolist() == picture[0, 1].tolist() == [128, 128, 128]
    assert (color_depth(np.zeros((2, 3))) == 128).all()
    assert len(np.unique(color_depth(np.full((2, 3), 4.0)))) <= 3


@pytest.mark.chromium
@pytest.mark.parametrize("width", [1200, 500])
def test_a_browser_shows_photo_and_render_side_by_side_and_nothing_overflows(
    tmp_path: Path, width: int
) -> None:
    _write(tmp_path, _example(height=240, width=320))
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    shot = tmp_path / "shot.png"
    options = (
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--hide-scrollbars",
        "--disable-background-networking",
    )
    subprocess.run(
        [
            str(browser),
            *options,
            f"--user-data-dir={tmp_path / 'profile'}",
            f"--window-size={width},1000",
            f"--screenshot={shot}",
            (tmp_path / "deep" / "report.html").as_uri(),
        ],
        check=True,
        capture_output=True,
        timeout=120,
    )
    pixels = np.asarray(Image.open(shot).convert("RGB")).astype(int)
    red = np.abs(pixels - [200, 30, 30]).max(axis=2) < 12
    green = np.abs(pixels - [30, 200, 30]).max(axis=2) < 12
    assert red.sum() > 20_000
    assert green.sum() > 20_000
    assert np.nonzero(red)[1].max() < np.nonzero(green)[1].min() + 20, "photo left of the line, render right"
    margin = pixels[:, -8:]
    assert np.ptp(margin.reshape(-1, 3), axis=0).max() <= 8, "the page ends before its right edge"


def test_photos_without_a_pose_are_shown_with_their_matches(tmp_path: Path) -> None:
    unplaced = (
        ReportUnplaced(HOSTILE, "too few matches", _flat(20, 60, (9, 90, 9))),
        ReportUnplaced("blank.jpg", "no features found", None),
    )
    file = tmp_path / "report.html"
    write_report(Report("t", "s", poses="8 photos have a pose.", unplaced=unplaced), file)
    page = Page(file)
    assert "8 photos have a pose." in page.text
    assert HOSTILE in page.text
    assert any("no features found" in text for text in page.text)
    ((attributes, picture),) = page.pictures()
    assert picture.size == (60, 20)
    assert HOSTILE in str(attributes["alt"])
    write_report(Report("t", "s"), file)
    assert "Camera poses" not in Page(file).text
