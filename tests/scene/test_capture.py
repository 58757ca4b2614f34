"""Copies of photos keep when and where they were taken."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from PIL.ExifTags import GPS, IFD, Base

from wildgs.scene.capture import carry_capture, read_capture


@pytest.fixture
def undistorted(tmp_path: Path) -> Path:
    file = tmp_path / "undistorted.jpg"
    pixels = np.random.default_rng(0).integers(0, 255, (12, 16, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(file)
    return file


def photo(folder: Path, *, timed: bool = True, placed: bool = True) -> Path:
    exif = Image.Exif()
    exif[Base.Orientation] = 6
    exif[Base.Model] = "a camera"
    details = exif.get_ifd(IFD.Exif)
    details[Base.FocalLengthIn35mmFilm] = 28
    if timed:
        details[Base.DateTimeOriginal] = "2019:07:01 19:30:00"
        details[Base.OffsetTimeOriginal] = "+02:00"
    if placed:
        exif.get_ifd(IFD.GPSInfo).update(
            {GPS.GPSLatitudeRef: "N", GPS.GPSLatitude: (52.0, 30.0, 0.0)}
            | {GPS.GPSLongitudeRef: "W", GPS.GPSLongitude: (13.0, 15.0, 0.0)}
        )
    file = folder / "photo.jpg"
    Image.new("RGB", (16, 12)).save(file, exif=exif)
    return file


def test_time_and_place_go_along_and_the_pixels_stay(undistorted: Path, tmp_path: Path) -> None:
    before = np.asarray(Image.open(undistorted))
    carry_capture(photo(tmp_path), undistorted)
    capture = read_capture(undistorted)
    assert capture is not None
    assert capture.local == datetime(2019, 7, 1, 19, 30)
    assert capture.utc == datetime(2019, 7, 1, 17, 30, tzinfo=UTC)
    assert capture.place == pytest.approx((52.5, -13.25))
    with Image.open(undistorted) as image:
        np.testing.assert_array_equal(np.asarray(image), before)
        exif = image.getexif()
    assert exif.get(Base.Orientation, 1) == 1, "pixels are upright already"
    assert Base.FocalLengthIn35mmFilm not in exif.get_ifd(IFD.Exif), "undistortion changes it"


@pytest.mark.parametrize("content", [None, b"", b"no picture", b"\xff\xd8\xff\xe1\x00\x10Exif\x00\x00broken"])
def test_photos_without_a_time_leave_the_file_as_it_is(
    undistorted: Path, tmp_path: Path, content: bytes | None
) -> None:
    before = undistorted.read_bytes()
    source = photo(tmp_path, timed=False, placed=False)
    if content is not None:
        source.write_bytes(content)
    carry_capture(source, undistorted)
    assert undistorted.read_bytes() == before


def test_a_block_that_no_segment_holds_is_left_out(undistorted: Path, tmp_path: Path) -> None:
    exif = Image.Exif()
    exif.get_ifd(IFD.GPSInfo)[GPS.GPSProcessingMethod] = b"x" * 40_000
    exif.get_ifd(IFD.GPSInfo)[GPS.GPSAreaInformation] = b"x" * 40_000
    Image.new("RGB", (16, 12)).save(tmp_path / "large.png", exif=exif)
    before = undistorted.read_bytes()
    carry_capture(tmp_path / "large.png", undistorted)
    assert undistorted.read_bytes() == before
