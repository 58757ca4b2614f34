import contextlib
import json
import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from PIL.ExifTags import IFD, Base

from wildgs.errors import UserError, WildGSWarning
from wildgs.scene import DataConfig, load_scene
from wildgs.scene.capture import read_capture
from wildgs.scene.colmap import read_model
from wildgs.sfm import matching, reconstruction, repeated_mapping
from wildgs.sfm.config import PairingConfig, SfmConfig
from wildgs.sfm.reconstruction import reconstruct
from wildgs.sfm.report import describe_placed, read_left_out
from wildgs.sfm.workplace import Workplace

Corner = tuple[list[np.ndarray], list[np.ndarray]]
# Affine shape finds more matches in photos as small as these.
AFFINE = SfmConfig(affine_features=True)
SMALL = SfmConfig(max_image_size=800)
EAGER = SfmConfig(pairing=PairingConfig(exhaustive_features=0, neighbours=3), affine_features=True)


@pytest.fixture(autouse=True)
def few_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few photos are mapped up to 24 times if some have no pose; tests of repeated mapping do without photos."""
    monkeypatch.setattr(repeated_mapping, "FEW_ATTEMPTS", 2)


def save_photos(folder: Path, photos: list[np.ndarray], **exif: Image.Exif) -> Path:
    folder.mkdir()
    for index, pixels in enumerate(photos):
        Image.fromarray(pixels).save(folder / f"photo {index}.jpg", quality=95)
    return folder


def camera_centres(scene: Path) -> dict[str, np.ndarray]:
    return {
        image.name: (-image.viewmat[:3, :3].T @ image.viewmat[:3, 3]).numpy()
        for image in read_model(scene).images
    }


def assert_similar(found: np.ndarray, truth: np.ndarray, tolerance: float) -> None:
    """Equal up to rotation, shift and scale (Umeyama), by the spread of the truth."""
    a, b = found - found.mean(axis=0), truth - truth.mean(axis=0)
    u, s, vt = np.linalg.svd(a.T @ b)
    sign = np.array([1, 1, np.sign(np.linalg.det(u @ vt))])
    fitted = a @ (u * sign) @ vt * (s * sign).sum() / (a**2).sum()
    assert np.abs(fitted - b).max() < tolerance * np.abs(b).max()


def test_photos_of_every_kind_become_a_scene(tmp_path: Path, corner: Corner) -> None:
    photos, positions = corner
    folder = save_photos(tmp_path / "my photos", photos[:3])
    (folder / "phone").mkdir()
    turned = Image.fromarray(
        np.rot90(photos[3], 1)
    )  # stored on its side, with the orientation that rights it
    exif = turned.getexif()
    exif[0x0112] = 6
    exif.get_ifd(IFD.Exif)[Base.DateTimeOriginal] = "2019:07:01 19:30:00"
    turned.save(folder / "phone/photo 3.jpg", quality=95, exif=exif)
    alpha = np.full(photos[4].shape[:2], 255, dtype=np.uint8)
    alpha[:, :60] = 0
    Image.fromarray(np.dstack([photos[4], alpha])).save(folder / "photo 4.png")
    Image.fromarray(photos[5]).convert("CMYK").save(folder / "photo 5.jpg", quality=98)
    Image.new("RGB", (320, 240), (90, 90, 90)).save(folder / "blank.jpg")
    whole = (folder / "photo 0.jpg").read_bytes()
    (folder / "broken.jpg").write_bytes(whole[: len(whole) // 2])
    (folder / "notes.txt").write_text("no photo")
    Image.fromarray(photos[2][30:, 40:]).save(folder / "crop.png")

    steps: list[tuple[str, int, int]] = []
    with (
        pytest.warns(WildGSWarning, match=r"broken\.jpg: .*left out"),
        pytest.warns(WildGSWarning, match=r"not used: notes\.txt"),
    ):
        report = reconstruct(folder, tmp_path / "scene", AFFINE, progress=lambda *step: steps.append(step))

    names = [
        "crop.jpg",
        "phone/photo 3.jpg",
        "photo 0.jpg",
        "photo 1.jpg",
        "photo 2.jpg",
        "photo 4.jpg",
        "photo 5.jpg",
    ]
    assert report.registered == tuple(names)
    assert report.photos == 9
    assert set(report.left_out) == {"blank.jpg", "broken.jpg"}
    assert "no features" in report.left_out["blank.jpg"]
    assert report.pairing == "exhaustive"
    assert report.copies == {"crop.png": "photo 2.jpg"}
    assert report.pairs == 22  # the crop is matched once
    assert set(report.placed) == set(names)
    assert all(how.placed_by == "first" and how.neighbours >= 2 for how in report.placed.values())
    assert all(0 < how.reprojection_error < 1 for how in report.placed.values())
    assert report.doubtful == {}
    assert report.pictures == {}  # a blank photo matches none
    left_out = {photo.name: photo for photo in read_left_out(tmp_path / "scene")}
    assert left_out["blank.jpg"].picture is None
    assert "7 photos have a pose, 0 of them by the second" in describe_placed(tmp_path / "scene")
    assert ("reading photos", 9, 9) in steps
    assert steps[-1][0] == "undistorting"
    assert any("blank.jpg" in line for line in report.lines())
    stored = json.loads((tmp_path / "scene/sfm_report.json").read_text())
    assert stored["registered"] == names
    assert sorted(p.name for p in tmp_path.iterdir()) == ["my photos", "scene"]  # nothing is left behind

    centres = camera_centres(tmp_path / "scene")
    order = [2, 3, 4, 1, 5, 6]
    assert_similar(np.stack([centres[names[i]] for i in order]), np.stack(positions), tolerance=0.03)

    scene = load_scene(tmp_path / "scene", DataConfig(holdout=0))
    assert [view.name for view in scene.views] == names
    for view in scene.views:
        assert view.camera.width > view.camera.height  # upright
        assert view.camera.viewmat[1, 2] < -0.9 or view.camera.up[2] > 0.9
    captures = [read_capture(tmp_path / "scene/images" / name) for name in names]
    assert [capture and capture.local.hour for capture in captures] == [
        None,
        19,
        None,
        None,
        None,
        None,
        None,
    ]
    mask = scene.views[5].read_mask()
    assert mask is not None
    assert (mask[:, :50] == 0).all()
    assert (mask[:, 70:] == 255).all()
    assert all(view.read_mask() is None for i, view in enumerate(scene.views) if i != 5)


def test_large_sets_are_paired_by_looks(tmp_path: Path, corner: Corner) -> None:
    report = reconstruct(save_photos(tmp_path / "p", corner[0]), tmp_path / "scene", EAGER)
    assert report.pairing == "retrieval"
    assert report.pairs < 15
    assert len(report.registered) == 6


def test_large_sets_with_gps_are_paired_by_it(tmp_path: Path, corner: Corner) -> None:
    (tmp_path / "p").mkdir()
    for index, pixels in enumerate(corner[0]):
        image = Image.fromarray(pixels)
        exif = image.getexif()
        exif.get_ifd(0x8825).update({1: "N", 2: (48.0, 53.0, 0.02 * index), 3: "E", 4: (2.0, 20.0, 0.0)})
        image.save(tmp_path / "p" / f"{index}.jpg", quality=95, exif=exif)
    report = reconstruct(tmp_path / "p", tmp_path / "scene", EAGER)
    assert report.pairing == "gps"
    assert len(report.registered) == 6


def test_an_existing_scene_is_replaced_only_on_demand(tmp_path: Path, corner: Corner) -> None:
    photos = save_photos(tmp_path / "p", corner[0][:4])
    output = tmp_path / "out"
    output.mkdir()
    (output / "keep.txt").write_text("the user's")
    reconstruct(photos, output)
    with pytest.raises(UserError, match="already contains a scene"):
        reconstruct(photos, output)
    (photos / "photo 3.jpg").unlink()
    assert len(reconstruct(photos, output, overwrite=True).registered) == 3
    assert len(list((output / "images").iterdir())) == 3
    assert (output / "keep.txt").read_text() == "the user's"
    assert len(load_scene(output).views) == 3
    assert sorted(p.name for p in tmp_path.iterdir()) == ["out", "p"]


def test_names_that_phones_and_old_disks_write(tmp_path: Path, corner: Corner) -> None:
    """Copies under plain names inside, the user's names outside."""
    (tmp_path / "p").mkdir()
    names = [b"2023-07-14 18:22:31.jpg", b"caf\xe9.jpg", b"line\nbreak.jpg", b"IMG_7"]
    for name, pixels in zip(names, corner[0], strict=False):
        path = tmp_path / "p" / os.fsdecode(name)
        Image.fromarray(pixels).save(path, "JPEG", quality=95)
    (tmp_path / "p" / os.fsdecode(b"br\xffken.jpg")).write_bytes(b"no photo")
    with pytest.warns(WildGSWarning, match=r"br\\xffken\.jpg: not a readable image"):
        report = reconstruct(tmp_path / "p", tmp_path / os.fsdecode(b"sc\xe8ne"))
    expected = ("2023-07-14 18:22:31.jpg", "IMG_7.jpg", "caf_.jpg", "line_break.jpg")
    assert report.registered == expected
    "\n".join(report.lines()).encode()  # can be printed
    assert any(r"caf\xe9.jpg: caf_.jpg" in line for line in report.lines())
    scene = load_scene(tmp_path / os.fsdecode(b"sc\xe8ne"))
    assert tuple(view.name for view in scene.views) == expected
    assert all(view.read_photo().float().std() > 5 for view in scene.views)
    stored = json.loads((scene.root / "sfm_report.json").read_text(encoding="utf-8"))
    assert stored["renamed"] == {"caf\udce9.jpg": "caf_.jpg", "line\nbreak.jpg": "line_break.jpg"}
    assert list(stored["left_out"]) == [os.fsdecode(b"br\xffken.jpg")]


@pytest.fixture
def old_scene(tmp_path: Path) -> Path:
    """A scene of an earlier run, with depth that was estimated and a mask that somebody drew."""
    output = tmp_path / "out"
    for name in ("images/old.jpg", "sparse/0/cameras.bin", "depth/old.png", "masks/a.png", "masks/drawn.png"):
        (output / name).parent.mkdir(parents=True, exist_ok=True)
        (output / name).write_text("old")
    (output / "sfm_report.json").write_text(json.dumps({"masks": ["a.png"]}))
    return output


@pytest.fixture
def new_scene(tmp_path: Path) -> Path:
    work = tmp_path / "work"
    for name in ("images/new.jpg", "sparse/0/cameras.bin", "sfm_report.json"):
        (work / name).parent.mkdir(parents=True, exist_ok=True)
        (work / name).write_text("new")
    return work


def content(folder: Path) -> dict[str, str]:
    return {p.relative_to(folder).as_posix(): p.read_text() for p in folder.rglob("*") if p.is_file()}


def test_what_belonged_to_the_replaced_scene_is_set_aside(old_scene: Path, new_scene: Path) -> None:
    """Depth and masks of other photos would be read as the new ones'."""
    with pytest.warns(
        WildGSWarning, match=r"depth_replaced/ and masks_replaced/ belonged to the replaced scene"
    ):
        reconstruction._move_in(new_scene, old_scene)
    assert content(old_scene) == {
        "images/new.jpg": "new",
        "sparse/0/cameras.bin": "new",
        "sfm_report.json": "new",
        "depth_replaced/old.png": "old",
        "masks_replaced/a.png": "old",
        "masks_replaced/drawn.png": "old",
    }


def test_masks_of_the_replaced_scene_itself_go_with_it(old_scene: Path, new_scene: Path) -> None:
    (old_scene / "masks/drawn.png").unlink()
    (old_scene / "depth/old.png").unlink()
    (old_scene / "depth").rmdir()
    reconstruction._move_in(new_scene, old_scene)
    assert set(content(old_scene)) == {"images/new.jpg", "sparse/0/cameras.bin", "sfm_report.json"}


@pytest.mark.parametrize("failing", range(1, 9))
@pytest.mark.parametrize("error", [OSError("disk"), KeyboardInterrupt()])
def test_a_replacement_that_fails_leaves_the_old_scene(
    old_scene: Path, new_scene: Path, monkeypatch: pytest.MonkeyPatch, failing: int, error: BaseException
) -> None:
    before, rename, calls = content(old_scene), Path.rename, [0]

    def fail(path: Path, target: Path) -> Path:
        calls[0] += 1
        if calls[0] == failing:
            raise error
        return rename(path, target)

    monkeypatch.setattr(Path, "rename", fail)
    with pytest.raises(type(error)):
        reconstruction._move_in(new_scene, old_scene)
    assert content(old_scene) == before


@pytest.mark.parametrize("again", [False, True])
@pytest.mark.parametrize("step", range(1, 10))
def test_a_replacement_that_was_killed_is_undone(
    old_scene: Path, new_scene: Path, monkeypatch: pytest.MonkeyPatch, step: int, again: bool
) -> None:
    """Wherever it was; also where the next call, which undoes it, is killed once more."""
    (new_scene / "masks").mkdir(exist_ok=True)
    (new_scene / "masks" / "new.png").touch()
    before = content(old_scene)

    def killed_at(call: int, name: str):
        original, calls = getattr(Path, name), [0]

        def move(path: Path, target: Path) -> Path:
            calls[0] += 1
            if calls[0] == call:
                raise KeyboardInterrupt
            return original(path, target)

        return move

    with monkeypatch.context() as patch:
        patch.setattr(Path, "rename", killed_at(step, "rename"))
        patch.setattr(reconstruction, "_restore", lambda _: None)
        with pytest.raises(KeyboardInterrupt):
            reconstruction._move_in(new_scene, old_scene)
    if again:
        with monkeypatch.context() as patch:
            patch.setattr(Path, "replace", killed_at(2, "replace"))
            with contextlib.suppress(KeyboardInterrupt):
                reconstruction._restore(old_scene)
    reconstruction._restore(old_scene)
    assert content(old_scene) == before


def test_the_faster_of_two_reconstructions_stays(
    tmp_path: Path, corner: Corner, monkeypatch: pytest.MonkeyPatch
) -> None:
    photos = save_photos(tmp_path / "p", corner[0][:4])
    write = reconstruction._write_scene

    def slow(*arguments: object) -> None:
        write(*arguments)  # pyright: ignore[reportArgumentType]
        (tmp_path / "out" / "images").mkdir(parents=True)
        (tmp_path / "out" / reconstruction.REPORT_NAME).touch()

    monkeypatch.setattr(reconstruction, "_write_scene", slow)
    with pytest.raises(UserError, match="already contains a scene"):
        reconstruct(photos, tmp_path / "out")


@pytest.mark.parametrize("place", ["a file/scene", "full"])
def test_a_place_that_cannot_be_written_is_one_line(
    tmp_path: Path, corner: Corner, monkeypatch: pytest.MonkeyPatch, place: str
) -> None:
    photos = save_photos(tmp_path / "p", corner[0][:2])
    (tmp_path / "a file").touch()
    if place == "full":

        def full(*_: object, **__: object) -> None:
            raise OSError(28, "No space left on device")

        monkeypatch.setattr("shutil.copyfile", full)
        monkeypatch.setattr(Image.Image, "save", full)
    with pytest.raises(UserError, match=r"cannot be written .*choose another --output"):
        reconstruct(photos, tmp_path / place)


def test_options_that_mean_nothing_are_refused() -> None:
    for name in ("max_features", "max_image_size", "max_image_pixels", "threads"):
        with pytest.raises(UserError, match=name.replace("_", "-")):
            SfmConfig(**{name: 0})


@pytest.mark.parametrize(
    ("number", "stage"), [(signal.SIGTERM, "extracting features"), (signal.SIGHUP, "finding poses")]
)
def test_after_a_signal_the_same_call_continues(
    tmp_path: Path, corner: Corner, monkeypatch: pytest.MonkeyPatch, number: int, stage: str
) -> None:
    """A scheduler's SIGTERM, a terminal that is closed: no stack of C++, and the work done is there."""
    photos = save_photos(tmp_path / "p", corner[0][:4])
    code = (
        "import os, sys; from pathlib import Path; from wildgs.cli import sfm\n"
        "from wildgs.sfm import reconstruction\n"
        f"def progress(stage, done, total): stage == {stage!r} and os.kill(os.getpid(), {int(number)})\n"
        f"reconstruction.reconstruct(Path({str(photos)!r}), Path({str(tmp_path / 'out')!r}), progress=progress)\n"
    )
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=200)
    assert "TerminatedError: terminated" in ended.stderr
    assert "***" not in ended.stderr
    assert "run the same command to continue" in ended.stderr
    monkeypatch.setattr(reconstruction, "copy_upright", None)  # not called again
    assert len(reconstruct(photos, tmp_path / "out").registered) == 4
    assert sorted(p.name for p in tmp_path.iterdir()) == ["out", "p"]


def test_folders_of_others_are_never_written_over(tmp_path: Path, corner: Corner) -> None:
    scene = tmp_path / "scene"
    scene.mkdir()
    photos = save_photos(scene / "images", corner[0][:2])
    with pytest.raises(UserError, match="photos are in this folder"):
        reconstruct(photos, scene, overwrite=True)
    elsewhere = save_photos(tmp_path / "p", corner[0][:2])
    with pytest.raises(UserError, match="not made by"):
        reconstruct(elsewhere, scene, overwrite=True)
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="is a file"):
        reconstruct(elsewhere, tmp_path / "file")
    assert len(list(photos.iterdir())) == 2


def test_photos_of_different_places_end_in_one_line(tmp_path: Path) -> None:
    noise = np.random.default_rng(0)
    blots = [np.kron(noise.integers(0, 255, (30, 40, 3)), np.ones((8, 8, 1))) for _ in range(3)]
    folder = save_photos(tmp_path / "p", [b.astype(np.uint8) for b in blots])
    with pytest.raises(UserError, match="3 photos do not match each other"):
        reconstruct(folder, tmp_path / "scene")
    assert [p.name for p in tmp_path.iterdir()] == ["p"]


def test_too_few_photos_end_in_one_line(tmp_path: Path, corner: Corner) -> None:
    with pytest.raises(UserError, match="no such folder"):
        reconstruct(tmp_path / "nowhere", tmp_path / "scene")
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match="no photos"):
        reconstruct(tmp_path / "empty", tmp_path / "scene")
    with pytest.raises(UserError, match="at least two"):
        reconstruct(save_photos(tmp_path / "one", corner[0][:1]), tmp_path / "scene")


@pytest.mark.shared
def test_all_of_sacre_coeur_registers(tmp_path: Path, shared: Path) -> None:
    report = reconstruct(shared / "data/sacre_coeur/images", tmp_path / "scene", SMALL)
    assert len(report.registered) == 10
    assert report.left_out == {}
    assert report.reprojection_error < 1
    scene = load_scene(tmp_path / "scene", DataConfig(downscale=4))
    assert len(scene.points) == report.points > 800
    assert torch.isfinite(scene.points).all()


@pytest.mark.shared
def test_sacre_coeur_registers_by_retrieval(tmp_path: Path, shared: Path) -> None:
    config = replace(SMALL, pairing=PairingConfig(exhaustive_features=0, neighbours=6))
    report = reconstruct(shared / "data/sacre_coeur/images", tmp_path / "scene", config)
    assert report.pairing == "retrieval"
    assert report.pairs < 45
    assert len(report.registered) >= 9


def test_colmap_decodes_no_more_at_once_than_we_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its threads keep whole pictures: four of 240 megapixels took 10 GB."""
    work = Workplace(tmp_path)
    work.images.mkdir()
    sides = [10, 10, 10, 40, 10, 10]
    for number, side in enumerate(sides):
        Image.new("RGB", (side, side)).save(work.images / f"{number}.jpg")
    monkeypatch.setattr(matching, "DECODING_PIXELS", 250)
    names = [f"{number}.jpg" for number in range(6)]
    assert list(matching._batches(work, names)) == [names[:2], names[2:3], names[3:4], names[4:]]
    monkeypatch.setattr(matching, "DECODING_PIXELS", 10**6)
    monkeypatch.setattr(matching, "EXTRACTION_BATCH", 4)
    assert list(matching._batches(work, names)) == [names[:4], names[4:]]
