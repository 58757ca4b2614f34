"""`wildgs.render` and `wildgs.gallery`: sizes, and outputs that are files."""

from __future__ import annotations

import math
import shutil
from pathlib import Path

import pytest
from PIL import Image

import wildgs
from wildgs.errors import UserError
from wildgs.geometry.camera_file import write_camera_path
from wildgs.library.config import MixOptions
from wildgs.library.rendering import check_size


@pytest.mark.parametrize("size", [(0, 0), (60_000, 60_000), (-4, 10), (16_384, 16_384)])
def test_sizes_that_are_no_picture_are_refused(size: tuple[int, int], trained: Path, tmp_path: Path) -> None:
    options = wildgs.TrajectoryOptions(size=size)
    with pytest.raises(UserError, match="--size"):
        wildgs.render(trained, tmp_path / "out", trajectory=options)
    check_size(16_384, 8_192)


@pytest.mark.parametrize("name", ["still.png", "still.jpg"])
def test_one_still_goes_into_a_file(name: str, trained: Path, tmp_path: Path) -> None:
    done = wildgs.render(trained, tmp_path / name)
    with Image.open(tmp_path / name) as picture:
        assert (done.pictures, done.size) == (1, picture.size)
        assert picture.format == {"still.png": "PNG", "still.jpg": "JPEG"}[name]
    scene = wildgs.load(trained)
    with pytest.raises(UserError, match="is one image"):
        wildgs.render(scene, tmp_path / name, views=[view.name for view in scene.views[:2]])


@pytest.mark.parametrize("name", ["sheet.jpg", "sheet.png"])
def test_a_gallery_may_be_a_file(name: str, trained: Path, tmp_path: Path) -> None:
    scene = wildgs.load(trained)
    written = wildgs.gallery(scene, tmp_path / name, views=[scene.views[0].name], appearance=["neutral"])
    assert written.sheet == tmp_path / name
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_without_held_out_photos_all_viewpoints_are_rendered(landmark: Path, tmp_path: Path) -> None:
    config = wildgs.RunConfig(method="3dgs", train=wildgs.TrainConfig(steps=2))
    scene = tmp_path / "scene"
    scene.mkdir()
    for part in ("images", "sparse"):
        (scene / part).symlink_to(landmark / part)
    run = wildgs.train(
        scene,
        wildgs.RunConfig(method="3dgs", data=wildgs.DataConfig(holdout=0), train=config.train),
        output=tmp_path / "run",
    )
    done = wildgs.render(run.folder, tmp_path / "out")
    assert done.pictures == len(wildgs.load(run.folder).views) == 9


def test_one_appearance_may_be_a_plain_name(trained: Path, tmp_path: Path) -> None:
    assert wildgs.render(trained, tmp_path / "a.png", appearance="neutral").pictures == 1
    view = wildgs.load(trained).views[0].name
    written = wildgs.gallery(trained, tmp_path / "b.jpg", views=[view], appearance="neutral")
    assert written.sheet.is_file()


@pytest.mark.parametrize("fps", [0.0, -5.0, math.nan, math.inf, 1e12])
def test_frame_rates_that_no_video_has_are_refused(fps: float, trained: Path, tmp_path: Path) -> None:
    scene = wildgs.load(trained)
    cameras = tmp_path / "cameras.json"
    write_camera_path(cameras, [view.camera for view in scene.views[:2]], fps=10.0)
    for path in ("orbit", str(cameras)):
        with pytest.raises(UserError, match="--fps"):
            wildgs.render(scene, tmp_path / "out", trajectory=wildgs.TrajectoryOptions(path=path, fps=fps))
    options = wildgs.TrajectoryOptions(path=str(cameras), seconds=9.0)
    with pytest.raises(UserError, match="--seconds"):
        wildgs.render(scene, tmp_path / "out", trajectory=options)


def test_a_run_is_not_written_among_the_photos(landmark: Path) -> None:
    config = wildgs.RunConfig(method="3dgs", train=wildgs.TrainConfig(steps=2))
    before = sorted(path.name for path in landmark.iterdir())
    for output in (landmark, landmark / "images", landmark / "sparse" / "run"):
        with pytest.raises(UserError, match="another --output"):
            wildgs.train(landmark, config, output=output)
    assert sorted(path.name for path in landmark.iterdir()) == before
    assert not (landmark / "images" / ".lock").exists()


@pytest.mark.parametrize("protocols", ["fuller", ["half", "Full"]])
def test_unknown_protocols_are_refused(protocols, trained: Path) -> None:
    with pytest.raises(UserError, match="choose full or half"):
        wildgs.evaluate(trained, protocols)


def test_a_protocol_may_be_a_plain_name(trained: Path) -> None:
    assert list(wildgs.evaluate(trained, "half")) == ["half"]


def _camera_file(scene: wildgs.LoadedScene, folder: Path, *sizes: tuple[int, int]) -> str:
    file = folder / "cameras.json"
    cameras = [scene.views[0].camera.resized(*size) for size in sizes]
    write_camera_path(file, cameras, fps=10.0)
    return str(file)


def test_the_cameras_of_a_file_may_show_a_day(trained: Path, tmp_path: Path) -> None:
    run = Path(shutil.copytree(trained, tmp_path / "run"))
    scene = wildgs.load(run)
    path = wildgs.TrajectoryOptions(path=_camera_file(scene, tmp_path, (24, 16), (24, 16)))
    assert wildgs.render(scene, tmp_path / "frames", over="day", trajectory=path).pictures == 2


def test_only_a_video_needs_one_size(trained: Path, tmp_path: Path) -> None:
    scene = wildgs.load(trained)
    path = wildgs.TrajectoryOptions(path=_camera_file(scene, tmp_path, (24, 16), (20, 10)))
    assert wildgs.render(scene, tmp_path / "frames", trajectory=path).size == (20, 10)
    for number, size in enumerate([(24, 16), (20, 10)]):
        with Image.open(tmp_path / "frames" / f"frame_{number:05d}.png") as picture:
            assert picture.size == size
    with pytest.raises(UserError, match="same image size; give a folder"):
        wildgs.render(scene, tmp_path / "a.mp4", trajectory=path)


@pytest.mark.parametrize("path", ["orbit", "training", "spiral", "file", None])
def test_views_that_a_path_does_not_use_are_refused(path: str | None, trained: Path, tmp_path: Path) -> None:
    scene = wildgs.load(trained)
    file = _camera_file(scene, tmp_path, (24, 16)) if path == "file" else path
    output = tmp_path / ("frames" if path else "a.mp4")
    with pytest.raises(UserError, match="--view is not used on the path"):
        wildgs.render(scene, output, views=["x.jpg"], trajectory=wildgs.TrajectoryOptions(path=file))


@pytest.mark.parametrize("option", ["seconds", "fps"])
def test_options_of_a_video_are_refused_for_views(option: str, trained: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=f"--{option} is only used for a video: add --path"):
        wildgs.render(trained, tmp_path / "out", trajectory=wildgs.TrajectoryOptions(**{option: 2.0}))


def test_views_and_appearances_given_twice_are_rendered_once(trained: Path, tmp_path: Path) -> None:
    scene = wildgs.load(trained)
    name = scene.views[0].name
    done = wildgs.render(
        scene, tmp_path / "out", views=[name, Path(name).stem], appearance=["neutral", "neutral"]
    )
    assert done.pictures == len(list((tmp_path / "out").rglob("*.png"))) == 1


def test_names_of_other_files_are_no_folders(trained: Path, tmp_path: Path) -> None:
    for name in ("c21.tiff", "a.PLY", "b.webp"):
        with pytest.raises(UserError, match=r"unsupported file type; use \.png or \.jpg"):
            wildgs.render(trained, tmp_path / name)
    (tmp_path / "old.png").mkdir()
    assert wildgs.render(trained, tmp_path / "old.png").output.is_dir()
    assert len(list((tmp_path / "old.png").rglob("*.png"))) == 2
    (tmp_path / "file").write_text("")
    for output in ("file", "file/a.png"):
        with pytest.raises(UserError, match="is a file; give a folder"):
            wildgs.render(trained, tmp_path / output)


def test_a_loaded_run_stays_where_it_is(trained: Path, tmp_path: Path, monkeypatch) -> None:
    shutil.copytree(trained, tmp_path / "here" / "run")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    scene = wildgs.load("run")
    monkeypatch.chdir(tmp_path / "elsewhere")
    (ply,) = wildgs.export(scene, "ply")
    assert ply.file == tmp_path / "here" / "run" / "export" / "neutral.ply"
    written = wildgs.gallery(scene, views=[scene.views[0].name], appearance="neutral")
    assert written.sheet.is_relative_to(tmp_path / "here")
    wildgs.evaluate(scene, "half")
    assert list((tmp_path / "elsewhere").iterdir()) == []


def test_pictures_of_one_name_keep_their_own_folders(trained: Path, tmp_path: Path) -> None:
    for folder, color in (("noon", (220, 220, 200)), ("night", (20, 25, 60))):
        (tmp_path / folder).mkdir()
        Image.new("RGB", (32, 24), color).save(tmp_path / folder / "light.png")
    pictures = [str(tmp_path / folder / "light.png") for folder in ("noon", "night")]
    view = wildgs.load(trained).scene.test_views[0].name
    borrowed = MixOptions(like=view)
    done = wildgs.render(trained, tmp_path / "out", appearance=pictures, views=[view], mixing=borrowed)
    written = sorted((tmp_path / "out").rglob("*.png"))
    assert [file.parent.name for file in written] == ["light_0", "light_1"]
    assert len(written) == done.pictures
    assert written[0].read_bytes() != written[1].read_bytes()
