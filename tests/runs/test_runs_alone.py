"""A run without its scene folder: everything but scoring and training works; what differs is said."""

from __future__ import annotations

import os
import shutil
import struct
from pathlib import Path

import pytest
import torch
from PIL import Image

import wildgs
from wildgs.config import with_entries
from wildgs.config_file import read_config, write_config
from wildgs.engine.recorder import Recorder
from wildgs.errors import UserError, WildGSWarning
from wildgs.library.day import known_day
from wildgs.library.doctor import write_report
from wildgs.library.logs import run_log
from wildgs.light.photos import encode_view
from wildgs.runs import CONFIG_FILE, WRITTEN, load_run, prepare_training, refuse_trained, require_same_scene
from wildgs.scene import load_scene
from wildgs.scene.carried import LIGHTS_FOLDER, SCENE_FILE

CPU = torch.device("cpu")


@pytest.fixture
def moved(trained: Path, tmp_path: Path) -> Path:
    """The run on another machine, where its scene is not."""
    return move(trained, tmp_path / "elsewhere" / "run", tmp_path / "gone")


def move(run: Path, target: Path, scene: Path) -> Path:
    shutil.copytree(run, target)
    config = read_config(target / CONFIG_FILE)
    write_config(target / CONFIG_FILE, with_entries(config, {"scene": str(scene)}))
    return target


@pytest.fixture
def old(trained: Path, tmp_path: Path) -> Path:
    """A run as earlier versions wrote it."""
    target = tmp_path / "old"
    shutil.copytree(trained, target)
    (target / SCENE_FILE).unlink()
    shutil.rmtree(target / LIGHTS_FOLDER)
    return target


def drop_photos(scene: Path, count: int) -> None:
    """Takes the last photos out of a scene's images.bin."""
    file = scene / "sparse" / "0" / "images.bin"
    content = file.read_bytes()
    (total,) = struct.unpack_from("<Q", content)
    position, ends = 8, []
    for _ in range(total):
        position += 4 + 7 * 8 + 4
        position = content.index(b"\0", position) + 1
        (points,) = struct.unpack_from("<Q", content, position)
        position += 8 + points * 24
        ends.append(position)
    file.write_bytes(struct.pack("<Q", total - count) + content[8 : ends[total - count - 1]])


def test_lights_and_renders_are_those_of_the_scene_folder(trained: Path, moved: Path) -> None:
    alone = wildgs.load(moved, CPU)
    full = load_run(trained, CPU).read_scene()
    assert not alone.run.config.scene.exists()
    for view, original in zip(alone.views, full.views, strict=True):
        look = alone.appearance(view.name)
        method = alone.run.method
        with torch.no_grad():
            expected = method.shade(encode_view(method, original))
            colors = method.render(view.camera, expected).colors
        difference = alone.render(view.camera, look).float() / 255 - colors.clamp(0, 1)
        assert difference.abs().mean() < 0.01


def test_verbs_work_on_the_run_alone(moved: Path, tmp_path: Path, monkeypatch) -> None:
    from wildgs.cli import main

    monkeypatch.chdir(tmp_path)
    name = wildgs.load(moved, CPU).views[1].name
    main(["export", str(moved), "--appearance", name, "--format", "html", "--output", "page.html"])
    assert Path("page.html").stat().st_size > 10_000
    main(["render", str(moved), "--appearance", name, "--view", name, "--output", "pictures"])
    assert len(list(Path("pictures").rglob("*.png"))) == 1
    main(["gallery", str(moved), "--output", "gallery"])
    assert Path("gallery/gallery.jpg").is_file()
    main(["appearance", str(moved), name, "--output", "light.safetensors"])
    assert Path("light.safetensors").is_file()


def test_the_viewer_opens_on_the_run_alone(moved: Path) -> None:
    from wildgs.viewer.photos import compare
    from wildgs.viewer.subject import Subject

    scene = wildgs.load(moved, CPU)
    subject = Subject(scene.run.method, scene.scene, scene.appearance)
    view = subject.views[0]
    seen = compare(subject, view, subject.look(view.name))
    assert seen.photo.shape == (view.camera.height, view.camera.width, 3)


def test_scoring_says_where_the_scene_was(moved: Path) -> None:
    with pytest.raises(UserError, match=r"gone: no such folder.*--scene"):
        load_run(moved, CPU).read_scene()


def test_scoring_finds_the_scene_elsewhere(moved: Path, landmark: Path) -> None:
    scene = load_run(moved, CPU).read_scene(landmark)
    assert scene.root == landmark
    assert len(scene.test_views) > 0


def test_a_run_of_an_earlier_version_opens(old: Path, landmark: Path) -> None:
    run = load_run(old, CPU)
    assert run.scene.root == landmark
    assert [v.name for v in run.scene.views] == [v.name for v in run.read_scene().views]
    with pytest.raises(UserError, match="--scene"):
        load_run(move(old, old.with_name("older"), old / "gone"), CPU).scene  # noqa: B018


def test_a_run_of_an_earlier_version_carries_its_scene_once_it_is_resumed(old: Path, landmark: Path) -> None:
    config = read_config(old / CONFIG_FILE)
    prepare_training(old, config, load_scene(landmark, config.data), resume=True)
    assert (old / SCENE_FILE).is_file()
    assert load_run(old, CPU).scene.root == old


def test_a_changed_scene_changes_no_camera_and_is_said(trained: Path, landmark: Path, tmp_path: Path) -> None:
    changed = tmp_path / "scene"
    shutil.copytree(landmark, changed)
    drop_photos(changed, 2)
    run = load_run(trained, CPU)
    with (
        pytest.warns(WildGSWarning, match="split.tsv names 2 photos"),
        pytest.warns(WildGSWarning, match=r"has changed since.*2 photos missing"),
    ):
        now = run.read_scene(changed)
    before = {view.name: view for view in run.read_scene().views}
    assert len(now.views) == len(before) - 2
    for view in now.views:
        assert torch.equal(view.camera.viewmat, before[view.name].camera.viewmat)
        assert view.split == before[view.name].split


def test_photos_masks_and_depth_that_were_exchanged_are_said(
    trained: Path, landmark: Path, tmp_path: Path
) -> None:
    """The cameras are the same, and so are the names: a score would be of other photos."""
    changed = tmp_path / "scene"
    shutil.copytree(landmark, changed)
    run = load_run(trained, CPU)
    run.read_scene(changed)
    first, second, third = sorted((changed / "images").iterdir())[:3]
    with Image.open(first) as image:
        image.transpose(Image.Transpose.FLIP_LEFT_RIGHT).save(first)
    (changed / "masks").mkdir(exist_ok=True)
    with Image.open(second) as image:
        Image.linear_gradient("L").resize(image.size).save(changed / "masks" / f"{second.name}.png")
    (changed / "depth" / f"{third.stem}.png").unlink()
    said = (
        rf"1 photo with another content: {first.name}; 1 photo with another mask: {second.name}; "
        rf"1 photo with another depth prior: {third.name}"
    )
    with pytest.warns(WildGSWarning, match=said):
        run.read_scene(changed)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes here")
def test_pipes_in_a_run_folder_are_not_waited_for(moved: Path, tmp_path: Path) -> None:
    for name in ("train.log", "metrics.jsonl", "photos.json", "day.json"):
        (moved / name).unlink(missing_ok=True)
        os.mkfifo(moved / name)
    assert "not a regular file" in write_report([], moved)
    with run_log(moved):
        pass
    with pytest.raises(UserError, match="not a regular file"):
        Recorder(moved)
    scene = wildgs.load(moved)
    assert known_day(scene) is None
    assert len(scene.photo_fits()) == 7
    (moved / SCENE_FILE).unlink()
    os.mkfifo(moved / SCENE_FILE)
    with pytest.raises(UserError, match=r"scene\.safetensors.*not a regular file"):
        _ = wildgs.load(moved).scene


def test_another_scene_is_not_trained_into_a_run(trained: Path, old: Path, make_scene) -> None:
    other = make_scene(9)
    for folder in (trained, old):
        config = read_config(folder / CONFIG_FILE)
        with pytest.raises(UserError, match=r"trained on another scene.*--output"):
            prepare_training(folder, config, load_scene(other), resume=True)
        assert read_config(folder / CONFIG_FILE) == config, "nothing was written"


def test_the_same_scene_elsewhere_may_go_on(trained: Path, old: Path, landmark: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(landmark, copy)
    for folder in (trained, old):
        require_same_scene(folder, load_scene(copy))
        trainer = prepare_training(folder, read_config(folder / CONFIG_FILE), load_scene(copy), resume=True)
        assert [view.name for view in trainer.views] == [view.name for view in load_scene(copy).train_views]


def test_a_look_of_another_run_is_refused(trained: Path) -> None:
    one, other = wildgs.load(trained, CPU), wildgs.load(trained, CPU)
    look = one.appearance(one.views[0].name)
    with pytest.raises(UserError, match="belongs to another run"):
        other.render(other.views[0].camera, look)


def test_a_file_that_is_written_again_gives_its_new_light(trained: Path, tmp_path: Path) -> None:
    scene = wildgs.load(trained, CPU)
    like = scene.views[0].name
    file = tmp_path / "cur.jpg"
    Image.new("RGB", (40, 30), (250, 240, 200)).save(file)
    bright = scene.appearance(file, like=like)
    assert scene.appearance(file, like=like) is bright
    Image.new("RGB", (40, 30), (10, 10, 60)).save(file)
    os.utime(file, ns=(1, 1))
    assert scene.appearance(file, like=like) is not bright


@pytest.mark.parametrize("name", WRITTEN)
def test_a_folder_with_files_of_somebody_else_is_no_output(tmp_path: Path, name: str) -> None:
    (tmp_path / "holiday.txt").touch()
    refuse_trained(tmp_path)
    (tmp_path / name).touch()
    with pytest.raises(UserError, match=f"{name} belongs to no run"):
        refuse_trained(tmp_path)
    (tmp_path / CONFIG_FILE).touch()  # of a run that was stopped before its first checkpoint
    refuse_trained(tmp_path)
