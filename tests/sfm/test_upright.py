import os
import struct
import threading
import time
import unicodedata
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image

from wildgs.errors import UserError, WildGSWarning
from wildgs.scene import images as images_module
from wildgs.scene.colmap import _checked_name
from wildgs.sfm.upright import copy_upright, list_photos, scene_names


def test_scene_names_are_jpegs_with_stems_of_their_own() -> None:
    names = ["a.jpg", "a.JPEG", "a.png", "b/a.png", "B.tif", "b.png", "a_png.webp"]
    result = scene_names(names)
    assert result[0] == "a.jpg"
    assert result[3] == "b/a.jpg"
    stems = [name.rsplit(".", 1)[0].casefold() for name in result]
    assert len(set(stems)) == len(names)
    assert all(name.lower().endswith((".jpg", ".jpeg")) for name in result)


def test_names_that_some_systems_take_for_one_are_kept_apart() -> None:
    """Case, and accents as one letter or two."""
    names = ["caf\u00e9.jpg", "cafe\u0301.jpg", "A.jpg", "a.jpg", "stra\u00dfe.jpg", "STRASSE.jpg"]
    folded = {unicodedata.normalize("NFC", name).casefold() for name in scene_names(names)}
    assert len(folded) == len(names)


def test_hidden_files_and_other_files_are_no_photos(tmp_path: Path) -> None:
    for name in ("b.JPG", "a.png", ".hidden.jpg", "notes.txt", "sub/c.jpeg", ".git/d.jpg"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    with pytest.warns(WildGSWarning, match=r"1 files are not photos by their extension .*: notes\.txt"):
        assert list_photos(tmp_path) == ["a.png", "b.JPG", "sub/c.jpeg"]
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match="no photos"):
        list_photos(tmp_path / "empty")


def test_photos_of_all_formats_and_without_an_ending_are_found(tmp_path: Path) -> None:
    picture = Image.new("RGB", (20, 10), (200, 10, 10))
    formats = {"a.jfif": "JPEG", "b.gif": "GIF", "c.jp2": "JPEG2000", "d.ppm": "PPM", "IMG_1": "JPEG"}
    for name, kind in formats.items():
        picture.save(tmp_path / name, format=kind)
    (tmp_path / "README").write_text("no photo")
    (tmp_path / "clip\nof.mp4").write_bytes(b"")
    os.mkfifo(tmp_path / "pipe.jpg")
    os.mkfifo(tmp_path / "pipe")
    with pytest.warns(WildGSWarning, match=r"4 files .* README, clip\\nof\.mp4, pipe and 1 more"):
        assert list_photos(tmp_path) == sorted(formats)
    with pytest.warns(WildGSWarning, match="4 files"):
        copies, broken = copy_upright(tmp_path, tmp_path / "i", tmp_path / "m")
    assert broken == {}
    assert [copy.scene_name for copy in copies] == ["IMG_1.jpg", "a.jpg", "b.jpg", "c.jpg", "d.jpg"]


def test_names_in_the_scene_can_be_held_by_every_part_of_it() -> None:
    long = "é" * 150
    names = [
        "2023-07-14 18:22:31.jpg",
        "C:x.jpg",
        "a\\b.jpg",
        "caf\udce9.jpg",
        "caf\udcea.jpg",
        "line\nbreak.jpg",
        "sub\x01/x.png",
        f"{long}.heic",
        f"{long}e.heic",
        "ok ü.jpg",
    ]
    result = scene_names(names)
    assert result[:7] == [
        "2023-07-14 18:22:31.jpg",
        "C_x.jpg",
        "a_b.jpg",
        "caf_.jpg",
        "caf__jpg.jpg",
        "line_break.jpg",
        "sub_/x.jpg",
    ]
    assert result[9] == "ok ü.jpg"
    assert len(set(result)) == len(names)
    for name in result:
        assert max(len(part.encode()) for part in name.split("/")) <= 240
        assert _checked_name(name, Path()) == name


def test_odd_exif_entries_do_not_cost_the_focal_length(tmp_path: Path) -> None:
    (tmp_path / "p").mkdir()
    image = Image.fromarray(np.random.default_rng(0).integers(0, 255, (40, 60, 3)).astype(np.uint8))
    exif = image.getexif()
    exif[0x0112] = 6
    exif.get_ifd(0x8769)[0xA405] = 35
    exif[0x011A] = 72.0
    block = exif.tobytes()
    order = "<" if block[6:8] == b"II" else ">"
    place = block.index(struct.pack(f"{order}HH", 0x011A, 5))  # XResolution, which becomes a text
    odd = struct.pack(f"{order}HHI4s", 0x011A, 2, 4, b"72a\0")
    image.save(tmp_path / "p/a.jpg", exif=block[:place] + odd + block[place + 12 :])
    copies, broken = copy_upright(tmp_path / "p", tmp_path / "i", tmp_path / "m")
    assert broken == {}
    copy = pycolmap.Bitmap.read(tmp_path / "i" / copies[0].work_name, True)
    assert (copy.width, copy.height) == (40, 60)
    assert copy.exif_focal_length() > 0


def test_decoders_are_bounded_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Four photos of 600 pixels never are in memory at once where 1,000 pixels may be; one of 2,000 comes alone."""
    monkeypatch.setattr(images_module, "DECODING_PIXELS", 1000)
    now, most, lock = set[int](), [], threading.Lock()
    load = images_module._load

    def slow_load(image: Image.Image) -> None:
        size = image.width * image.height
        with lock:
            now.add(size)
            most.append(sum(now))
        time.sleep(0.02)
        load(image)
        with lock:
            now.discard(size)

    monkeypatch.setattr(images_module, "_load", slow_load)
    (tmp_path / "p").mkdir()
    for number in range(6):
        Image.new("RGB", (30, 20 + number)).save(tmp_path / f"p/{number}.png")
    Image.new("RGB", (50, 40)).save(tmp_path / "p/large.png")
    copies, _ = copy_upright(tmp_path / "p", tmp_path / "i", tmp_path / "m")
    assert len(copies) == 7
    assert max(total for total in most if total != 2000) <= 1000


def test_upright_copies_keep_focal_length_and_position(tmp_path: Path) -> None:
    (tmp_path / "p").mkdir()
    pixels = np.random.default_rng(0).integers(0, 255, (40, 60, 3)).astype(np.uint8)
    image = Image.fromarray(pixels)
    exif = image.getexif()
    exif[0x0112] = 8
    exif.get_ifd(0x8769)[0xA405] = 35  # focal length in 35 mm film
    exif.get_ifd(0x8825).update({1: "S", 2: (33.0, 51.0, 0.0), 3: "E", 4: (151.0, 12.0, 0.0)})
    image.save(tmp_path / "p/a.jpg", exif=exif)
    copies, broken = copy_upright(tmp_path / "p", tmp_path / "i", tmp_path / "m")
    assert broken == {}
    copy = pycolmap.Bitmap.read(tmp_path / "i" / copies[0].work_name, True)
    original = pycolmap.Bitmap.read(tmp_path / "p/a.jpg", True)
    assert (copy.width, copy.height) == (40, 60)
    assert copy.exif_focal_length() == pytest.approx(original.exif_focal_length())
    assert copy.exif_focal_length() > 0
    assert copies[0].position == pytest.approx((-33.85, 151.2))  # read although there is no altitude
    upright = np.rot90(np.asarray(Image.open(tmp_path / "p/a.jpg")), 1)
    assert np.abs(copy.to_array().astype(int) - upright).mean() < 4
    assert not (tmp_path / "m").exists()


def test_upright_jpegs_are_copied_byte_for_byte(tmp_path: Path) -> None:
    (tmp_path / "p").mkdir()
    Image.new("RGB", (30, 20), (200, 10, 10)).save(tmp_path / "p/a.jpg")
    copies, _ = copy_upright(tmp_path / "p", tmp_path / "i", tmp_path / "m")
    assert (tmp_path / "i" / copies[0].work_name).read_bytes() == (tmp_path / "p/a.jpg").read_bytes()


def test_broken_photos_and_giants_are_reported(tmp_path: Path) -> None:
    (tmp_path / "p").mkdir()
    Image.new("RGB", (30, 20)).save(tmp_path / "p/a.png")
    Image.new("RGB", (300, 200)).save(tmp_path / "p/giant.png")
    (tmp_path / "p/b.png").write_bytes(b"\x89PNG broken")
    with pytest.warns(WildGSWarning) as caught:
        copies, broken = copy_upright(tmp_path / "p", tmp_path / "i", tmp_path / "m", max_pixels=1000)
    assert [copy.name for copy in copies] == ["a.png"]
    assert set(broken) == {"b.png", "giant.png"}
    assert len(caught) == 2


def test_links_to_nothing_are_named(tmp_path: Path) -> None:
    Image.new("RGB", (8, 8)).save(tmp_path / "a.jpg")
    (tmp_path / "gone.jpg").symlink_to(tmp_path / "nowhere.jpg")
    with pytest.warns(WildGSWarning, match="1 links point to files that do not exist.*gone.jpg"):
        assert list_photos(tmp_path) == ["a.jpg"]


def test_links_to_folders_are_followed_once(tmp_path: Path) -> None:
    folder, elsewhere = tmp_path / "photos", tmp_path / "elsewhere"
    folder.mkdir()
    (elsewhere / ".hidden").mkdir(parents=True)
    for path in (folder / "a.jpg", elsewhere / "b.jpg", elsewhere / ".hidden/c.jpg"):
        Image.new("RGB", (8, 8)).save(path)
    (folder / "holiday").symlink_to(elsewhere, target_is_directory=True)
    (elsewhere / "back").symlink_to(folder, target_is_directory=True)
    assert list_photos(folder) == ["a.jpg", "holiday/b.jpg"]
