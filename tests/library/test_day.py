"""The day of a run: found once, kept, and rendered."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from datetime import datetime
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from PIL.ExifTags import IFD, Base

import wildgs
from wildgs.errors import UserError
from wildgs.library import day as day_module
from wildgs.library.config import TrajectoryOptions
from wildgs.library.day import (
    DAY_FILE,
    DAY_VERSION,
    day_timeline,
    find_day,
    in_order_of_day,
    known_day,
    read_captures,
)
from wildgs.light.day import plan_day
from wildgs.light.shadows import SIDE, SunFinder
from wildgs.model.appearance import Appearance
from wildgs.scene import View
from wildgs.scene.capture import Capture, carry_capture


@pytest.fixture(scope="module")
def run(trained: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return Path(shutil.copytree(trained, tmp_path_factory.mktemp("day") / "run"))


def test_a_day_is_found_once_and_kept(run: Path) -> None:
    scene = wildgs.load(run)
    (run / DAY_FILE).unlink(missing_ok=True)
    said: list[str] = []
    day = find_day(scene, progress=lambda what, *_: said.append(what))
    assert set(day.phases) <= {view.name for view in scene.scene.train_views}
    assert len(day.keys) > 2
    assert said
    said.clear()
    assert find_day(scene, progress=lambda what, *_: said.append(what)) == day == known_day(scene)
    assert not said
    assert in_order_of_day(scene, day.keys)
    assert not in_order_of_day(scene, day.keys[::-1])
    content = json.loads((run / DAY_FILE).read_text(encoding="utf-8"))
    without = {key: value for key, value in content.items() if key != "version"}
    for old in ({**content, "step": 1}, {**content, "version": DAY_VERSION - 1}, without):
        (run / DAY_FILE).write_text(json.dumps(old), encoding="utf-8")
        assert known_day(scene) is None
    (run / DAY_FILE).write_text("{", encoding="utf-8")
    assert find_day(scene) == day


def test_times_of_the_original_photos_are_read(run: Path, tmp_path: Path) -> None:
    scene = wildgs.load(run)
    for number, view in enumerate(scene.views):
        exif = Image.Exif()
        exif.get_ifd(IFD.Exif)[Base.DateTimeOriginal] = f"2020:05:01 {6 + number:02d}:00:00"
        Image.new("RGB", (8, 6)).save(tmp_path / view.name, exif=exif)
    day = find_day(scene, tmp_path)  # seven photos with a time are too few to be believed
    assert not day.by_time


def test_a_run_without_its_scene_knows_the_times(run: Path, tmp_path: Path) -> None:
    alone = Path(shutil.copytree(run, tmp_path / "run"))
    config = alone / "config.yaml"
    scene = str(wildgs.load(run).run.config.scene)
    config.write_text(
        config.read_text(encoding="utf-8").replace(scene, str(tmp_path / "gone")), encoding="utf-8"
    )
    loaded = wildgs.load(alone)
    assert read_captures(loaded) == {}
    exif = Image.Exif()
    exif.get_ifd(IFD.Exif)[Base.DateTimeOriginal] = "2020:05:01 17:00:00"
    name = loaded.views[3].name
    Image.new("RGB", (8, 6)).save(tmp_path / "timed.jpg", exif=exif)
    carry_capture(tmp_path / "timed.jpg", loaded.views[3].photos.file(name))
    assert {name: capture.local.hour for name, capture in read_captures(loaded).items()} == {name: 17}


def test_times_that_were_corrected_give_another_day(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As many photos with a time, and other times: the day of the wrong clock is not shown again."""
    scene, hours = wildgs.load(run), [9]

    def captures(*_: object) -> dict[str, Capture]:
        return {view.name: Capture(datetime(2020, 5, 1, hours[0])) for view in scene.views}

    monkeypatch.setattr(day_module, "read_captures", captures)
    made: list[object] = []
    monkeypatch.setattr(day_module, "plan_day", lambda *given: made.append(given) or plan_day(*given))
    for hour, count in ((9, 1), (9, 1), (10, 2)):
        hours[0] = hour
        find_day(scene)
        assert len(made) == count
    monkeypatch.undo()
    (run / DAY_FILE).unlink()


@pytest.mark.parametrize(
    "change",
    [{"keys": []}, {"keys": ["nobody.jpg"]}, {"phases": {"nobody.jpg": 1.0}}, {"left_out": 3}, {"more": 1}],
)
def test_a_damaged_day_is_found_again(run: Path, change: dict) -> None:
    scene = wildgs.load(run)
    find_day(scene)
    content = json.loads((run / DAY_FILE).read_text(encoding="utf-8"))
    (run / DAY_FILE).write_text(json.dumps(content | change), encoding="utf-8")
    assert known_day(scene) is None


def test_original_photos_that_are_not_there_are_named(run: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no such folder; give the folder of the original photos"):
        wildgs.render(run, tmp_path / "frames", over="day", photos=tmp_path / "nowhere")
    with pytest.raises(UserError, match="--photos is only used with --over day"):
        wildgs.render(run, tmp_path / "frames", photos=tmp_path)


def test_original_photos_may_have_other_endings(run: Path, tmp_path: Path) -> None:
    scene = wildgs.load(run)
    exif = Image.Exif()
    exif.get_ifd(IFD.Exif)[Base.DateTimeOriginal] = "2020:05:01 06:00:00"
    Image.new("RGB", (8, 6)).save(tmp_path / f"{Path(scene.views[0].name).stem}.webp", exif=exif)
    assert list(read_captures(scene, tmp_path)) == [scene.views[0].name]


def test_the_pictures_change_at_an_even_pace(run: Path) -> None:
    scene = wildgs.load(run)
    timeline = day_timeline(scene, find_day(scene), scene.views[0].camera)
    frames = [frame.float() for frame in scene.frames([scene.views[0].camera] * 25, timeline)]
    steps = np.array([float((a - b).abs().mean()) for a, b in pairwise(frames)])
    assert steps.max() < 2 * steps.mean()


def test_a_day_is_rendered_from_a_view_of_its_own_choice(run: Path, tmp_path: Path) -> None:
    done = wildgs.render(
        run, tmp_path / "frames", over="day", trajectory=TrajectoryOptions("still", 0.2, size=(24, 16))
    )
    assert done.pictures == len(list((tmp_path / "frames").glob("*.png"))) == 6
    assert done.day is not None
    assert [look.name for look in done.looks] == list(done.day.keys)


def test_over_day_takes_no_other_light(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from wildgs.cli import main

    with pytest.raises(SystemExit) as ended:
        main(["render", str(run), "--over", "day", "--to", "a.jpg", "--output", str(tmp_path / "a")])
    assert ended.value.code == 2
    assert "--over uses the light of all photos" in capsys.readouterr().err


def test_a_run_with_one_light_has_no_day(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = wildgs.load(run)
    monkeypatch.setattr(type(scene), "relightable", property(lambda _: False))
    (run / DAY_FILE).unlink(missing_ok=True)
    with pytest.raises(UserError, match="needs a run that can be relit"):
        find_day(scene)


def test_a_day_keeps_small_masks(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of 200 photos are in memory at once; a small mask tells the same pixels apart."""
    large = torch.zeros(1800, 2400)
    large[:, 1200:] = 1.0
    small = day_module._small(large)
    assert max(small.shape) < 2 * SIDE
    assert small.untyped_storage().nbytes() < large.untyped_storage().nbytes() / 50
    assert small.shape[1] * 3 == small.shape[0] * 4
    assert small.mean() == pytest.approx(0.5, abs=0.01)
    assert day_module._small(torch.ones(6, 8)).shape == (6, 8)

    scene, kept = wildgs.load(run), []
    encode = scene.encode

    def with_large_mask(view: View) -> Appearance:
        return replace(encode(view), visibility=large)

    def keep(self: SunFinder, photo: object, camera: object, masks: tuple) -> torch.Tensor:
        kept.append(masks[1])
        return torch.zeros(3)

    monkeypatch.setattr(scene, "encode", with_large_mask)
    monkeypatch.setattr(SunFinder, "direction", keep)
    (run / DAY_FILE).unlink(missing_ok=True)
    find_day(scene)
    (run / DAY_FILE).unlink()
    assert len(kept) == len(day_module._usable_views(scene))
    assert all(mask.untyped_storage().nbytes() < 4 * (2 * SIDE) ** 2 for mask in kept)
