"""What a run folder carries of its scene, and what it says when the scene folder has changed."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from PIL.ExifTags import IFD, Base

from tests.memory_views import make_view
from wildgs.errors import UserError, WildGSWarning
from wildgs.geometry.camera import Camera
from wildgs.scene import Alignment, DataConfig, Scene, load_scene
from wildgs.scene import carried as module
from wildgs.scene.capture import read_capture
from wildgs.scene.carried import SCENE_FILE, carried_side, carry_scene, describe_carried, read_carried_scene
from wildgs.scene.scene_record import SceneRecord

MakeScene = Callable[..., Path]


@pytest.fixture
def scene(make_scene: MakeScene) -> Scene:
    root = make_scene(9)
    (root / "masks").mkdir()
    mask = np.full((32, 48), 255, dtype=np.uint8)
    mask[:7] = 0
    Image.fromarray(mask).save(root / "masks" / "p03.png.png")
    return load_scene(root)


def carried(scene: Scene, folder: Path) -> Scene:
    carry_scene(folder, scene)
    found = read_carried_scene(folder)
    assert found is not None
    return found


def test_copies_tell_when_the_photo_was_taken(scene: Scene, tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[Base.Model] = "a camera"
    exif.get_ifd(IFD.Exif)[Base.DateTimeOriginal] = "2020:05:01 17:00:00"
    view = scene.views[2]
    original = view.photos.file(view.name)
    assert original is not None
    with Image.open(original) as image:
        image.copy().save(original, exif=exif)
    found = carried(scene, tmp_path / "run")
    files = [view.photos.file(view.name) for view in found.views]
    captures = [read_capture(file) for file in files if file is not None]
    assert [capture and capture.local.hour for capture in captures] == [None, None, 17, *6 * [None]]


def test_cameras_points_and_split_come_back_bit_for_bit(scene: Scene, tmp_path: Path) -> None:
    found = carried(scene, tmp_path / "run")
    assert found.root == tmp_path / "run"
    assert [(v.name, v.split) for v in found.views] == [(v.name, v.split) for v in scene.views]
    for one, other in zip(found.views, scene.views, strict=True):
        assert torch.equal(one.camera.viewmat, other.camera.viewmat)
        assert torch.equal(one.camera.K, other.camera.K)
        assert (one.camera.width, one.camera.height) == (other.camera.width, other.camera.height)
    for name in ("points", "point_colors", "observations"):
        assert torch.equal(getattr(found, name), getattr(scene, name))
    assert found.alignment.to_dict() == scene.alignment.to_dict()
    assert len(scene.observations) == 9 * 60, "every photo of this scene observes every point"


def test_photos_and_masks_come_back_at_the_cameras_size(scene: Scene, tmp_path: Path) -> None:
    found = carried(scene, tmp_path / "run")
    for one, other in zip(found.views, scene.views, strict=True):
        difference = one.read_photo().float() - other.read_photo().float()
        assert difference.abs().mean() < 2
        assert one.read_disparity() is None
        assert one.read_clean() is None
    mask, original = found.views[3].read_mask(), scene.views[3].read_mask()
    assert mask is not None
    assert original is not None
    assert torch.equal(mask, original)
    assert found.views[2].read_mask() is None


def test_large_photos_are_carried_small_and_read_large(tmp_path: Path) -> None:
    y, x = torch.meshgrid(torch.linspace(0, 255, 900), torch.linspace(0, 255, 1200), indexing="ij")
    photo = torch.stack([x, y, 255 - x], dim=-1).to(torch.uint8)
    camera = Camera(torch.eye(4), torch.tensor([[900.0, 0, 600], [0, 900, 450], [0, 0, 1]]), 1200, 900)
    mask = torch.full((900, 1200), 255, dtype=torch.uint8)
    mask[:300] = 0
    view = make_view("a.jpg", camera, "train", photo, mask=mask)
    scene = Scene(
        tmp_path, (view,), torch.zeros(1, 3), torch.zeros(1, 3, dtype=torch.uint8), Alignment.identity()
    )
    found = carried(scene, tmp_path / "run")
    with Image.open(tmp_path / "run" / "lights" / "00000.jpg") as stored:
        assert stored.size == (512, 384)
    assert found.views[0].photos.detail == 512
    read = found.views[0].read_photo()
    assert read.shape == (900, 1200, 3)
    assert (read.float() - photo.float()).abs().mean() < 1
    kept = found.views[0].read_mask()
    assert kept is not None
    assert ((kept > 0) == (mask > 0)).float().mean() > 0.99


@pytest.mark.parametrize(("count", "side"), [(1, 512), (500, 512), (3200, 258), (10**6, 64)])
def test_many_photos_are_carried_smaller(count: int, side: int) -> None:
    assert carried_side([(1600, 1200)] * count) == side


def test_the_size_is_said(scene: Scene, tmp_path: Path) -> None:
    carry_scene(tmp_path, scene)
    assert "9 photos" in describe_carried(tmp_path)
    assert "MB" in describe_carried(tmp_path)


def test_a_photo_that_was_lost_is_named(scene: Scene, tmp_path: Path) -> None:
    found = carried(scene, tmp_path)
    (tmp_path / "lights" / "00004.jpg").unlink()
    with pytest.raises(UserError, match=r"00004\.jpg: no such file.*p04\.png"):
        found.views[4].read_photo()


@pytest.mark.parametrize("file", ["00004.jpg", "00003.mask.png"])
@pytest.mark.parametrize("change", ["lost", "of another photo", "a pipe"])
def test_lights_are_those_that_were_written(scene: Scene, tmp_path: Path, file: str, change: str) -> None:
    """Without its mask, or with the photo of another run, a light would be another one, silently."""
    found = carried(scene, tmp_path)
    path, view = tmp_path / "lights" / file, found.views[int(file[:5])]
    path.unlink()
    if change == "a pipe":
        os.mkfifo(path)
    elif change != "lost":
        Image.new("RGB" if file.endswith("jpg") else "1", (48, 32), 1).save(path)
    said = {"lost": "no such file", "a pipe": "not a regular file"}.get(
        change, "damaged, or from another run"
    )
    with pytest.raises(UserError, match=rf"{file}: {said}.*{view.name}.*copy the complete run folder again"):
        view.read_photo()


def test_masks_that_an_earlier_attempt_left_are_not_used(scene: Scene, tmp_path: Path) -> None:
    (tmp_path / "lights").mkdir()
    Image.new("1", (48, 32)).save(tmp_path / "lights" / "00002.mask.png")
    assert carried(scene, tmp_path).views[2].read_mask() is None


def test_runs_without_a_list_of_their_lights_open(scene: Scene, tmp_path: Path) -> None:
    carry_scene(tmp_path, scene)
    SceneRecord.of(scene).write(tmp_path / SCENE_FILE)  # as earlier versions did
    found = read_carried_scene(tmp_path)
    assert found is not None
    assert found.views[3].read_mask() is not None


def test_a_photo_that_is_gone_when_the_run_starts_is_left_out(scene: Scene, tmp_path: Path) -> None:
    lazy = load_scene(scene.root, lazy=True)
    (scene.root / "images" / "p02.png").unlink()
    found = carried(lazy, tmp_path)
    assert len(found.views) == 9
    with pytest.raises(UserError, match=r"p02\.png"):
        found.views[2].read_photo()


@pytest.mark.parametrize("keep", [0, 7, 100, 3000])
def test_a_record_cut_short_is_one_line(scene: Scene, tmp_path: Path, keep: int) -> None:
    carry_scene(tmp_path, scene)
    content = (tmp_path / SCENE_FILE).read_bytes()
    (tmp_path / SCENE_FILE).write_bytes(content[:keep])
    with pytest.raises(UserError, match=r"scene\.safetensors.*copy the complete run folder again"):
        read_carried_scene(tmp_path)


@pytest.mark.parametrize(
    "change",
    [
        {"names": ("a", "b")},
        {"observations": torch.tensor([[0, 10**6]], dtype=torch.int32)},
        {"K": torch.zeros(9, 3, 3)},
        {"viewmats": torch.full((9, 4, 4), float("nan"))},
        {"sizes": torch.zeros(9, 2, dtype=torch.int32)},
        {"alignment": replace(Alignment.identity(), scale=float("nan"))},
        {"sizes": torch.full((9, 2), 10**6, dtype=torch.int32)},
        {"sizes": torch.tensor([[2**23 + 48, 32]] * 9, dtype=torch.int32)},
    ],
)
def test_a_record_that_makes_no_sense_is_one_line(scene: Scene, tmp_path: Path, change) -> None:
    replace(SceneRecord.of(scene), **change).write(tmp_path / SCENE_FILE)
    with pytest.raises(UserError, match=r"scene\.safetensors"):
        read_carried_scene(tmp_path)


def test_an_unchanged_scene_is_adopted_without_a_word(scene: Scene, make_scene: MakeScene) -> None:
    adopted, differences = SceneRecord.of(scene).adopt(load_scene(scene.root))
    assert differences == []
    for one, other in zip(adopted.views, scene.views, strict=True):
        assert torch.equal(one.camera.viewmat, other.camera.viewmat)
        assert torch.equal(one.read_photo(), other.read_photo())


def test_whatever_changed_the_runs_own_cameras_and_split_stay(scene: Scene) -> None:
    """Photos taken out move the model's alignment and every eighth photo: nothing of it reaches the run."""
    record = SceneRecord.of(scene)
    fewer = load_scene(scene.root)
    moved = replace(fewer.views[5].camera, viewmat=fewer.views[5].camera.viewmat.clone())
    moved.viewmat[0, 3] += 0.5
    views = [replace(view, split="train") for view in fewer.views if view.name not in ("p01.png", "p02.png")]
    views = [replace(view, camera=moved) if view.name == "p05.png" else view for view in views]
    views.append(replace(views[-1], name="new.png"))
    adopted, differences = record.adopt(
        replace(fewer, views=tuple(views), points=fewer.points[:30], point_colors=fewer.point_colors[:30])
    )
    text = "; ".join(differences)
    assert "2 photos missing: p01.png, p02.png" in text
    assert "1 photo new (not used): new.png" in text
    assert "1 photo with another pose (the run's is used): p05.png" in text
    assert "2 photos in another split" in text
    assert "other sparse points" in text
    assert [view.name for view in adopted.views] == [f"p{i:02d}.png" for i in (0, 3, 4, 5, 6, 7, 8)]
    assert [view.name for view in adopted.test_views] == ["p00.png", "p08.png"]
    assert torch.equal(adopted.views[3].camera.viewmat, scene.views[5].camera.viewmat)
    assert torch.equal(adopted.points, scene.points)
    assert len(adopted.observations) == 7 * 60
    assert int(adopted.observations[:, 0].max()) == 6


def test_the_same_model_in_another_frame_is_the_same_scene(scene: Scene) -> None:
    turn = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)
    other = Alignment(turn, torch.tensor([3.0, 0, 1], dtype=torch.float64), 0.5)
    seen = load_scene(scene.root, alignment=other)
    assert SceneRecord.of(scene).is_of(seen)
    assert SceneRecord.of(scene).adopt(seen)[1] == []


def test_another_scene_is_told_from_the_same(scene: Scene, make_scene: MakeScene) -> None:
    record = SceneRecord.of(scene)
    assert not record.is_of(replace(scene, views=scene.views[:4]))
    cameras = [replace(view.camera, viewmat=torch.eye(4)) for view in scene.views]
    views = tuple(replace(view, camera=camera) for view, camera in zip(scene.views, cameras, strict=True))
    assert not record.is_of(replace(scene, views=views)), "equal names, other places"


def test_photos_that_differ_by_their_ending_share_nothing(make_scene: MakeScene) -> None:
    root = make_scene(names=["a.jpg", "a.png", "b.png"])
    for folder in ("depth", "masks"):
        (root / folder).mkdir()
    codes = np.full((32, 48), 65535, dtype=np.uint16)
    for name, value in (("a.jpg", 1), ("a.png", 3)):
        Image.fromarray(codes // value).save(root / "depth" / f"{name}.png")
    Image.fromarray(codes).save(root / "depth" / "a.png")
    mask = Image.fromarray(np.tri(32, 48, dtype=np.uint8))
    mask.save(root / "masks" / "a.png")
    with pytest.warns(WildGSWarning, match=r"depth: 1 files .* not used: a\.png"):
        first, second, _ = load_scene(root, DataConfig(holdout=0)).views
    assert float(first.read_disparity().max()) == 1  # pyright: ignore[reportOptionalMemberAccess]
    assert float(second.read_disparity().max()) == pytest.approx(1 / 3, abs=1e-4)  # pyright: ignore
    assert first.read_mask() is None
    assert second.read_mask() is not None


def test_nothing_is_written_over_by_a_second_run_that_fails(
    scene: Scene, tmp_path: Path, monkeypatch
) -> None:
    carry_scene(tmp_path, scene)
    before = (tmp_path / SCENE_FILE).read_bytes()

    def fail(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(module.Image.Image, "save", fail)
    with pytest.raises(UserError, match="No space left"):
        carry_scene(tmp_path, scene)
    assert (tmp_path / SCENE_FILE).read_bytes() == before
