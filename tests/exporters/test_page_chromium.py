"""The exported page in a real browser: its pixels are the renderer's, and it follows the hand."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from wildgs.exporters.page import Page, PageLight, PageView, write_page
from wildgs.exporters.splats import Splats
from wildgs.geometry.camera import Camera
from wildgs.rasterize import rasterize

pytestmark = [pytest.mark.chromium, pytest.mark.timeout(900)]

NEAR = 0.05
PATIENCE = 300_000  # milliseconds: software WebGL on a busy machine
LOOK = "async (camera) => (await wildgs.ready).look(camera)"
LIGHT = "async (value) => (await wildgs.ready).lights.set(value)"
SNAPSHOT = "async () => (await wildgs.ready).snapshot()"
PLACE = "async () => (await wildgs.ready).stage.camera.position.toArray()"
SETTLE = "async () => (await wildgs.ready).settle()"


def _camera() -> Camera:
    """To one side and with an off-centre picture, as crops of photos have it."""
    angle = torch.tensor(0.3)
    viewmat = torch.eye(4)
    viewmat[:3, :3] = torch.tensor([[angle.cos(), 0, -angle.sin()], [0, 1, 0], [angle.sin(), 0, angle.cos()]])
    viewmat[:3, 3] = torch.tensor([0.2, -0.1, 7.0])
    return Camera(viewmat, torch.tensor([[110.0, 0, 52], [0, 105, 40], [0, 0, 1]]), 112, 76)


def _scene(splats: Splats) -> tuple[Splats, list[torch.Tensor]]:
    """Opaque and faint, small and sky-sized Gaussians; the second light is brighter than white in places."""
    scales = splats.scales * 3
    scales[:2] = 4.0
    means = splats.means.clone()
    means[:2, 2] += 12
    scene = Splats(means, splats.quats, scales, splats.opacities, splats.sh)
    other = splats.sh.flip(-1).clone()
    other[:, 0] += 1.2
    return scene, [splats.sh, other]


@pytest.fixture(scope="module")
def opened(chromium, splats: Splats, tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Any]]:
    splats, lights = _scene(splats)
    shades = [np.full((20, 30, 3), shade, np.uint8) for shade in (60, 200)]
    file = tmp_path_factory.mktemp("page") / "page.html"
    page = Page(
        "Test & <title>", "", splats,
        [PageLight(f"light {index}", sh, shades[index]) for index, sh in enumerate(lights)],
        PageView(_camera(), 7.0), NEAR,
    )  # fmt: skip
    write_page(page, file)
    tab = chromium.new_page(viewport={"width": 420, "height": 300})
    said: list[str] = []
    asked: list[str] = []
    tab.on("console", lambda message: said.append(message.text) if message.type == "error" else None)
    tab.on("pageerror", lambda error: said.append(str(error)))
    tab.on("request", lambda request: asked.append(request.url))
    tab.goto(file.as_uri())
    tab.wait_for_function("document.documentElement.dataset.state", timeout=PATIENCE)
    yield {"tab": tab, "splats": splats, "lights": lights, "said": said, "asked": asked, "file": file}
    tab.close()


def _picture(url: str) -> torch.Tensor:
    image = Image.open(io.BytesIO(base64.b64decode(url.split(",")[1]))).convert("RGB")
    return torch.from_numpy(np.array(image)).float() / 255


def _expected(splats: Splats, sh: torch.Tensor, **filter: Any) -> torch.Tensor:
    rendering = rasterize(
        splats.means, splats.quats, splats.scales, splats.opacities, sh.contiguous(), _camera(),
        sh_degree=3, near=NEAR, backend="reference", **filter,
    )  # fmt: skip
    return rendering.colors.clamp(0, 1)


def _psnr(first: torch.Tensor, second: torch.Tensor) -> float:
    return float(-10 * torch.log10((first - second).square().mean()))


@pytest.mark.parametrize("value", [0.0, 1.0, 0.5])
def test_pixels_are_those_of_the_renderer(opened: dict[str, Any], value: float) -> None:
    tab, lights = opened["tab"], opened["lights"]
    camera = _camera()
    tab.evaluate(LIGHT, value)
    tab.evaluate(
        LOOK, {"viewmat": camera.viewmat.tolist(), "K": camera.K.tolist(), "width": 112, "height": 76}
    )
    shown = _picture(tab.evaluate(SNAPSHOT))
    blended = (1 - value) * lights[0] + value * lights[1]
    assert shown.shape == (76, 112, 3)
    assert _psnr(shown, _expected(opened["splats"], blended)) > 32
    other = lights[0] if value >= 0.5 else lights[1]
    assert _psnr(shown, _expected(opened["splats"], other)) < 20


@pytest.mark.parametrize("antialiased", [False, True])
def test_the_filter_is_that_of_the_run(chromium, splats: Splats, tmp_path: Path, antialiased: bool) -> None:
    """Gaussians of about a third of a pixel, to which the filter makes most of the difference."""
    splats, lights = _scene(splats)
    splats = replace(splats, scales=splats.scales / 8)
    thumbnail, camera = np.zeros((20, 30, 3), np.uint8), _camera()
    filter = {"eps2d": 0.1, "antialiased": antialiased}
    page = Page(
        "Small", "", splats, [PageLight("one", lights[0], thumbnail)], PageView(camera, 7.0), NEAR, **filter
    )
    write_page(page, tmp_path / "page.html")
    tab = chromium.new_page(viewport={"width": 420, "height": 300})
    tab.goto((tmp_path / "page.html").as_uri())
    tab.wait_for_function("document.documentElement.dataset.state", timeout=PATIENCE)
    tab.evaluate(
        LOOK, {"viewmat": camera.viewmat.tolist(), "K": camera.K.tolist(), "width": 112, "height": 76}
    )
    shown = _picture(tab.evaluate(SNAPSHOT))
    tab.close()
    same = _psnr(shown, _expected(splats, lights[0], **filter))
    other = _psnr(shown, _expected(splats, lights[0], eps2d=0.1, antialiased=not antialiased))
    assert same > other + 6, (same, other)
    assert same > 32


def test_the_slider_and_the_thumbnails_change_the_light(opened: dict[str, Any]) -> None:
    tab = opened["tab"]
    tab.locator("#slider").fill("0")
    first = _picture(tab.evaluate(SNAPSHOT))
    tab.locator("#slider").fill("0.6")
    second = _picture(tab.evaluate(SNAPSHOT))
    tab.locator("#strip button").nth(1).click()
    tab.wait_for_function("document.querySelectorAll('#strip button')[1].ariaPressed === 'true'")
    tab.wait_for_function("document.getElementById('slider').value === '1'", timeout=PATIENCE)
    third = _picture(tab.evaluate(SNAPSHOT))
    assert (second - first).abs().mean() > 0.02
    assert third.mean() > second.mean() > first.mean()


def test_dragging_orbits_and_keys_fly(opened: dict[str, Any]) -> None:
    tab = opened["tab"]
    tab.locator("#reset").click()
    tab.evaluate(SETTLE)
    before, start = _picture(tab.evaluate(SNAPSHOT)), torch.tensor(tab.evaluate(PLACE))
    tab.mouse.move(200, 120)
    tab.mouse.down()
    tab.mouse.move(260, 130, steps=4)
    tab.mouse.up()
    tab.evaluate(SETTLE)
    moved, place = _picture(tab.evaluate(SNAPSHOT)), torch.tensor(tab.evaluate(PLACE))
    target = torch.tensor(tab.evaluate("async () => (await wildgs.ready).navigation.orbit.target.toArray()"))
    assert (moved - before).abs().mean() > 0.01
    assert (place - start).norm() > 0.3
    assert (place - target).norm() == pytest.approx(float((start - target).norm()), rel=1e-3)
    tab.locator("#mode").click()
    tab.locator("#view").focus()
    tab.keyboard.down("KeyW")
    tab.wait_for_timeout(500)
    tab.keyboard.up("KeyW")
    tab.evaluate(SETTLE)
    assert (torch.tensor(tab.evaluate(PLACE)) - target).norm() < (place - target).norm() - 0.1
    tab.locator("#reset").click()
    tab.evaluate(SETTLE)
    assert _psnr(_picture(tab.evaluate(SNAPSHOT)), before) > 40


def test_a_phone_shows_everything_in_its_frame(opened: dict[str, Any], chromium, tmp_path: Path) -> None:
    phone = chromium.new_context(viewport={"width": 360, "height": 640}, has_touch=True, is_mobile=True)
    tab = phone.new_page()
    tab.goto(opened["file"].as_uri())
    tab.wait_for_function("document.documentElement.dataset.state === 'ready'", timeout=PATIENCE)
    for selector in ("#mode", "#reset", "#strip", "#slider"):
        box = tab.locator(selector).bounding_box()
        assert box is not None
        assert box["x"] >= 0
        assert box["x"] + box["width"] <= 360
    assert tab.evaluate("document.documentElement.scrollWidth") <= 360
    phone.close()


def test_it_opened_without_network_and_without_complaint(opened: dict[str, Any]) -> None:
    elsewhere = [url for url in opened["asked"] if not url.startswith(("file:", "blob:", "data:"))]
    assert elsewhere == []
    assert [url for url in opened["asked"] if url.startswith("file:")] == [opened["file"].as_uri()]
    assert opened["said"] == []
    assert opened["tab"].evaluate("document.querySelector('h1').textContent") == "Test & <title>"


STATE = """async () => {
  const page = await wildgs.ready;
  await page.settle();
  const { position, target } = page.navigation.place();
  return { position, target, light: page.lights.value };
}"""


def test_the_link_to_a_view_reopens_it_on_a_phone(opened: dict[str, Any], chromium) -> None:
    tab = opened["tab"]
    tab.locator("#reset").click()
    tab.mouse.move(200, 120)
    tab.mouse.down()
    tab.mouse.move(250, 140, steps=4)
    tab.mouse.up()
    tab.evaluate(LIGHT, 0.25)
    tab.locator("#link").click()
    wanted = tab.evaluate(STATE)
    assert "#view=" in tab.url
    phone = chromium.new_page(viewport={"width": 390, "height": 760}, has_touch=True, is_mobile=True)
    phone.goto(tab.url)
    phone.wait_for_function("document.documentElement.dataset.state", timeout=PATIENCE)
    found = phone.evaluate(STATE)
    assert found["light"] == pytest.approx(0.25)
    for key in ("position", "target"):
        np.testing.assert_allclose(found[key], wanted[key], atol=2e-3)
    box = phone.locator("#lights").bounding_box()
    assert box["x"] >= 0
    assert box["x"] + box["width"] <= 390
    phone.touchscreen.tap(*(box["x"] + box["width"] / 2, box["y"] + 30))
    phone.close()


def test_a_link_that_makes_no_sense_opens_the_first_view(opened: dict[str, Any]) -> None:
    tab = opened["tab"]
    tab.locator("#reset").click()
    before = tab.evaluate(STATE)
    tab.evaluate("location.hash = '#view=1,2,nobody&light=bright'")
    assert tab.evaluate(STATE) == before


def test_a_day_passes_while_it_plays(chromium, splats: Splats, tmp_path: Path) -> None:
    shade = np.full((20, 30, 3), 90, np.uint8)
    lights = [PageLight(f"{n}.jpg", splats.sh[:, :1] + 0.3 * n, shade) for n in range(6)]
    few = splats.with_sh(splats.sh[:, :1])
    page = Page("A day", "", few, lights, PageView(_camera(), 7.0), NEAR, day=True)
    write_page(page, tmp_path / "day.html")
    tab = chromium.new_page(viewport={"width": 200, "height": 150})
    tab.goto((tmp_path / "day.html").as_uri())
    tab.wait_for_function("document.documentElement.dataset.state", timeout=PATIENCE)
    assert tab.locator("#play").inner_text() == "Day"
    slider = tab.locator("#slider").bounding_box()
    assert slider["x"] >= 0
    assert slider["x"] + slider["width"] <= 200, "the evening is out of reach"
    tab.locator("#play").click()
    tab.wait_for_function("Number(document.getElementById('slider').value) > 0.4", timeout=PATIENCE)
    tab.wait_for_function("Number(document.getElementById('slider').value) > 1.2", timeout=PATIENCE)
    tab.locator("#play").click()
    tab.close()
