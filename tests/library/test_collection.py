"""Photos that are others than those that the poses were made from."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import wildgs
from wildgs.config_file import write_config
from wildgs.errors import UserError
from wildgs.library.collection import changed_options, compare_collection, record_collection
from wildgs.library.pipeline import CPU_LONG_SIDE, GPU_LONG_SIDE, _configure, _photo_size
from wildgs.runs import lock_run
from wildgs.sfm.config import PairingConfig, SfmConfig


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    """Three photos."""
    folder = tmp_path / "photos"
    (folder / "more").mkdir(parents=True)
    for number, name in enumerate(("a.jpg", "b.png", "more/c.jpg")):
        pixels = np.full((8, 8, 3), 40 * number, dtype=np.uint8)
        Image.fromarray(pixels).save(folder / name)
    return folder


@pytest.fixture
def scene(photos: Path, tmp_path: Path) -> Path:
    """Stands for a scene that was made from them."""
    folder = tmp_path / "run" / "scene"
    (folder / "sparse" / "0").mkdir(parents=True)
    record_collection(photos, folder, SfmConfig(max_features=500))
    return folder


def test_the_same_photos_copied_elsewhere_are_the_same(photos: Path, scene: Path, tmp_path: Path) -> None:
    assert not compare_collection(photos, scene)
    copied = photos.rename(tmp_path / "elsewhere")
    os.utime(copied / "a.jpg", (1, 1))
    assert not compare_collection(copied, scene)


def test_every_difference_is_named(photos: Path, scene: Path) -> None:
    (photos / "b.png").unlink()
    Image.new("RGB", (8, 8), "red").save(photos / "new.jpg")
    content = bytearray((photos / "a.jpg").read_bytes())
    content[-3] ^= 1
    (photos / "a.jpg").write_bytes(content)
    os.utime(photos / "a.jpg", (1, 1))
    changes = compare_collection(photos, scene)
    assert (changes.added, changes.removed, changes.changed) == (("new.jpg",), ("b.png",), ("a.jpg",))
    with pytest.raises(UserError, match=r"1 added \(new\.jpg\), 1 missing \(b\.png\), 1 changed \(a\.jpg\)"):
        wildgs.run(photos, scene.parent)


def test_the_folder_of_the_photos_is_not_to_be_deleted(photos: Path, scene: Path) -> None:
    Image.new("RGB", (8, 8), "red").save(photos / "new.jpg")
    with pytest.raises(UserError, match=f"or delete {scene.parent} to start again"):
        wildgs.run(photos, scene.parent)
    inside = photos.rename(scene / "images")
    with pytest.raises(UserError, match=r"choose another --output$"):
        wildgs.run(inside, scene.parent)


def test_a_scene_without_a_record_is_compared_by_names(photos: Path, tmp_path: Path) -> None:
    scene = tmp_path / "old"
    (scene / "images").mkdir(parents=True)
    for name in ("a.jpg", "b.jpg"):  # as structure from motion calls them
        Image.new("RGB", (8, 8)).save(scene / "images" / name)
    assert not compare_collection(photos, scene)
    Image.new("RGB", (8, 8)).save(scene / "images" / "other.jpg")
    assert compare_collection(photos, scene).removed == ("other.jpg",)


def test_a_folder_that_does_not_exist_is_refused_whatever_is_there(scene: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="nowhere: no such folder"):
        wildgs.run(tmp_path / "nowhere", scene.parent)


def test_a_second_run_on_one_output_is_refused_at_once(photos: Path, tmp_path: Path) -> None:
    with lock_run(tmp_path / "run"), pytest.raises(UserError, match="in use"):
        wildgs.run(photos, tmp_path / "run")
    assert not (tmp_path / "run" / "scene").exists()


def test_every_photo_has_a_limit_of_its_own_unless_the_run_began_otherwise(tmp_path: Path) -> None:
    assert _photo_size(tmp_path, None, None).downscale == 1
    assert _photo_size(tmp_path, None, None).max_side in (CPU_LONG_SIDE, GPU_LONG_SIDE)
    assert _photo_size(tmp_path, None, 2.0) == wildgs.DataConfig(downscale=2.0)
    assert _photo_size(tmp_path, 300, 2.0) == wildgs.DataConfig(downscale=2.0, max_side=300)
    # As earlier versions began it: one divisor for all.
    write_config(tmp_path / "config.yaml", wildgs.RunConfig(data=wildgs.DataConfig(downscale=2.7)))
    assert _photo_size(tmp_path, None, None) == wildgs.DataConfig(downscale=2.7)
    assert _photo_size(tmp_path, 300, None).max_side == 300


def test_options_that_are_left_out_are_those_of_the_run(tmp_path: Path) -> None:
    """A bare `wildgs run PHOTOS --output RUN` continues; what is given again is compared with the run."""
    file = tmp_path / "config.yaml"
    data, train = wildgs.DataConfig(downscale=2.0, holdout=4), wildgs.TrainConfig(steps=7)
    begun = wildgs.RunConfig(tmp_path, data=data, train=train)
    write_config(file, begun)
    assert _configure(tmp_path, file, None, _photo_size(tmp_path, None, None), None, None) == begun
    other = _configure(tmp_path, file, 9, _photo_size(tmp_path, None, 3.0), 50, 0)
    assert (other.train.steps, other.data.downscale, other.data.holdout) == (9, 3.0, 0)
    assert other.train.density.max_gaussians == 50


def test_other_photos_are_refused_by_a_run_that_has_poses(photos: Path, scene: Path) -> None:
    Image.fromarray(np.full((8, 8, 3), 200, dtype=np.uint8)).save(photos / "added.jpg")
    with pytest.raises(UserError, match=r"has changed since .*added\.jpg.*--output"):
        wildgs.run(photos, scene.parent)
    assert not (scene.parent / "checkpoints").exists()


def test_other_options_than_those_of_the_poses_are_refused(photos: Path, scene: Path) -> None:
    """They would be dropped without a word; threads decide nothing, and a default may stand for what was given."""
    asked = SfmConfig(max_features=900, pairing=PairingConfig(neighbours=7), threads=1)
    with pytest.raises(UserError, match=r"--neighbours was 32, not 7, --max-features was 500, not 900"):
        wildgs.run(photos, scene.parent, sfm=asked)
    assert not changed_options(scene, SfmConfig(threads=2))


@pytest.mark.parametrize("inside", ["", "run", "more/run"])
def test_an_output_among_the_photos_is_refused(photos: Path, inside: str) -> None:
    """Its pictures would be photos of the next run."""
    for verb in (wildgs.run, wildgs.reconstruct):
        with pytest.raises(UserError, match="is inside the folder of the photos"):
            verb(photos, photos / inside)
    assert len(list(photos.rglob("*"))) == 4


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes here")
def test_a_record_that_is_no_file_is_refused(photos: Path, scene: Path) -> None:
    (scene / "collection.json").unlink()
    os.mkfifo(scene / "collection.json")
    with pytest.raises(UserError, match="not a regular file"):
        wildgs.run(photos, scene.parent)
