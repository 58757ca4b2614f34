from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image

from wildgs.errors import UserError, WildGSWarning
from wildgs.sfm.upright import copy_upright, list_photos, scene_names


def test_scene_names_are_jpegs_with_stems_of_their_own() -> None:
    names = ["a.jpg", "a.JPEG", "a.png", "b/a.png", "B.tif", "b.png", "a_png.webp"]
    result = scene_names(names)
    assert result[0] == "a.jpg"
    assert result[3] == "b/a.jpg"
    stems = [name.rsplit(".", 1)[0].casefold() for name in result]
    assert len(set(stems)) == len(names)
    assert all(name.lower().endswith((".jpg", ".jpeg")) for name in result)


def test_hidden_files_and_other_files_are_no_photos(tmp_path: Path) -> None:
    for name in ("b.JPG", "a.png", ".hidden.jpg", "notes.txt", "sub/c.jpeg", ".git/d.jpg"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    assert list_photos(tmp_path) == ["a.png", "b.JPG", "sub/c.jpeg"]
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match="no photos"):
        list_photos(tmp_path / "empty")


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
