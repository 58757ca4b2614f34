"""What masks hide of what is static by proof, and photos that fit no light; parity with independent scripts."""

from __future__ import annotations

import json
import re
import runpy
import shutil
import sys
from dataclasses import replace

import pytest
import torch

import wildgs
from benchmarks.resized_demo import write_resized_demo
from tests.memory_views import MemoryPhotos
from wildgs.config import RunConfig
from wildgs.engine.config import DensityConfig, TrainConfig
from wildgs.evaluation.photos import (
    PHOTOS_FILE,
    PhotoFit,
    describe_misfits,
    find_misfits,
    inspect_photos,
    read_photos,
    summarize_photos,
)
from wildgs.model.config import ParsingConfig, WildGSConfig, WrappingConfig
from wildgs.model.wildgs import WildGS
from wildgs.runs import load_run
from wildgs.scene.images import Photo


@pytest.fixture
def run(trained, tmp_path):
    """A copy of the trained run, whose masks hide the left part of every photo."""
    shutil.copytree(trained, tmp_path / "run")
    return tmp_path / "run"


@pytest.fixture
def half_hidden(monkeypatch):
    parse = WildGS.parse

    def hide_left(self, photo, **options):
        ramp = torch.linspace(0, 1.25, photo.shape[1]).clamp(max=1).expand(photo.shape[:2]).contiguous()
        return replace(parse(self, photo, **options), visibility=ramp)

    monkeypatch.setattr(WildGS, "parse", hide_left)


def printed(monkeypatch, capsys, script, *arguments) -> str:
    monkeypatch.setattr(sys, "argv", [str(script), *map(str, arguments)])
    capsys.readouterr()
    runpy.run_path(str(script))
    return capsys.readouterr().out


def numbers(text: str, *words: str) -> list[float]:
    found = [re.search(rf"{word} (-?\d+\.\d+)", text) for word in words]
    assert all(found), text
    return [float(match[1]) for match in found if match is not None]


@pytest.mark.shared
def test_measures_without_truth_are_those_of_the_tools(half_hidden, shared, tmp_path, monkeypatch, capsys):
    """The tools read COLMAP's own observations and the written pictures, with pycolmap, numpy and Pillow alone."""
    scene = write_resized_demo(tmp_path / "scene", photos=9, long_side=160)
    model = WildGSConfig(parsing=ParsingConfig(max_side=32), wrapping=WrappingConfig(resolution=16))
    train = TrainConfig(steps=4, density=DensityConfig(max_gaussians=20_000))
    run, config = tmp_path / "run", RunConfig(model=model, train=train)
    wildgs.train(scene, config, output=run)
    scores = wildgs.evaluate(run)
    full, tools = scores["full"], shared / "tools"
    masks = printed(monkeypatch, capsys, tools / "masked_tracks.py", run, scene)
    assert numbers(masks, "hidden") == pytest.approx([full["static_hidden"]], abs=0.005)
    worst = float(masks.rpartition(" ")[2].strip("]\n"))
    assert worst == pytest.approx(full["static_hidden_worst"], abs=0.02)
    assert 0.05 < full["static_hidden"] < 0.9  # not an equality of zeros
    apart = printed(monkeypatch, capsys, tools / "landmark_psnr.py", scene, run)
    both = re.findall(r"landmark (\d+\.\d+) elsewhere (\d+\.\d+)", apart)
    assert float(both[0][0]) == pytest.approx(full["mean"]["landmark"], abs=0.05)
    assert float(both[0][1]) == pytest.approx(full["mean"]["elsewhere"], abs=0.05)
    assert float(both[1][0]) == pytest.approx(scores["half"]["mean"]["landmark"], abs=0.05)
    fine = printed(monkeypatch, capsys, tools / "detail.py", scene, run)
    expected = numbers(fine, "hp-energy", "hp-corr")
    assert expected == pytest.approx(
        [full["mean"]["detail_energy"], full["mean"]["detail_correlation"]], abs=2e-3
    )


def fit(
    name: str,
    psnr: float | None = 20.0,
    hidden: float = 0.05,
    static: float | None = 0.0,
    structure: float = 0.7,
) -> PhotoFit:
    return PhotoFit(name, psnr, structure, hidden, static, 0 if static is None else 100)


USUAL = [fit(f"{number}.jpg", 20 + 0.3 * (number % 7)) for number in range(20)]


def test_an_even_collection_has_no_misfits():
    assert find_misfits(USUAL) == []
    assert describe_misfits(USUAL) == []


def test_bad_fits_and_photos_that_are_hidden_are_named_worst_first():
    odd = [
        fit("print.jpg", 12.0),
        fit("far.jpg", 5.0, 0.3),
        fit("frame.jpg", 22.0, 0.7),
        fit("all.jpg", None, 1.0, structure=0.0),
        fit("mirrored.jpg", structure=0.2),
    ]
    named = [photo.name for photo in find_misfits([*USUAL, *odd])]
    assert set(named) == {photo.name for photo in odd}
    assert named.index("far.jpg") < named.index("print.jpg")
    lines = describe_misfits([*USUAL, *odd])
    assert "5 of 25" in lines[0]
    assert any("frame.jpg: 22.0 dB, structure 0.70, 70% hidden" in line for line in lines)


def test_half_of_a_collection_cannot_make_the_other_half_look_odd():
    bright, dark = (
        [fit(f"b{i}", 25.0 + 0.1 * i) for i in range(10)],
        [fit(f"d{i}", 17 + 0.1 * i) for i in range(9)],
    )
    assert find_misfits([*bright, *dark]) == []


def test_before_anything_is_learnt_structure_names_nobody():
    photos = [fit(f"{number}.jpg", structure=0.02 * (number % 5)) for number in range(20)]
    assert find_misfits(photos) == []


def test_few_photos_have_no_usual_fit():
    assert find_misfits([*USUAL[:5], fit("odd.jpg", 3.0)]) == []


def test_shares_are_weighted_by_observations_and_empty_without_tracks():
    photos = [
        PhotoFit("a", 20.0, 0.5, 0.1, 0.5, 10),
        PhotoFit("b", 20.0, 0.5, 0.1, 0.0, 90),
        fit("c", static=None),
    ]
    found = summarize_photos(photos)
    assert found["static_hidden"] == pytest.approx(0.05)
    assert found["static_hidden_worst"] == 0.5
    assert summarize_photos([fit("c", static=None)])["static_hidden"] is None
    assert summarize_photos([])["static_hidden_worst"] is None


def test_a_photo_of_something_else_is_found(run):
    loaded = load_run(run)
    scene = loaded.scene
    views = [replace(view, name=f"{copy}-{view.name}") for copy in range(2) for view in scene.train_views]
    for view in views:
        object.__setattr__(
            view, "photos", MemoryPhotos({view.name: scene.views[0].photos.get(view.name[2:])})
        )
    noise = torch.randint(0, 2, (views[0].camera.height, views[0].camera.width, 1)).expand(-1, -1, 3) * 255
    poster = MemoryPhotos({"poster.png": Photo(noise.to(torch.uint8).numpy())})
    views.append(replace(views[0], name="poster.png", photos=poster))
    photos = inspect_photos(
        loaded.method, replace(scene, views=tuple(views), observations=scene.observations[:0])
    )
    worst = min(photos, key=lambda photo: photo.psnr or 0.0)
    assert worst.name == "poster.png"
    assert [photo.name for photo in find_misfits(photos)] == ["poster.png"]
    assert all(photo.static_hidden is None for photo in photos)


def test_training_leaves_the_fit_of_its_photos_in_the_run(run):
    loaded = load_run(run)
    stored = read_photos(run, loaded.step)
    assert stored is not None
    assert [photo.name for photo in stored] == [view.name for view in loaded.scene.train_views]
    assert wildgs.load(run).photo_fits() == stored
    assert read_photos(run, loaded.step + 1) is None  # of another state of the run
    (run / PHOTOS_FILE).write_text("{", encoding="utf-8")
    again = wildgs.load(run).photo_fits()
    assert [photo.name for photo in again] == [photo.name for photo in stored]
    assert json.loads((run / PHOTOS_FILE).read_text(encoding="utf-8"))["step"] == loaded.step
