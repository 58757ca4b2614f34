"""`wildgs.render` and `wildgs.gallery`: sizes, and outputs that are files."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from PIL import Image

import wildgs
from wildgs.errors import UserError
from wildgs.geometry.camera_file import write_camera_path
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
