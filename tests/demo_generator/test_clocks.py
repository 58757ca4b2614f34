"""The demo's photos tell when and where they were taken, as those of tourists do."""

from __future__ import annotations

import io
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from PIL.ExifTags import IFD, Base

from demo_generator.clocks import Clock, add_clock, draw_clock, exif_block, zone_of
from demo_generator.ephemeris import LATITUDE, LONGITUDE, find_time, sun_at
from demo_generator.lighting import Light, draw_light
from wildgs.light.sun import sun_position
from wildgs.scene.capture import read_capture, with_exif
from wildgs.scene.demo import write_demo_scene

MIDDAY = Light(50.0, 30.0)


def _lights() -> list[Light]:
    rng = np.random.default_rng(2)
    return [
        draw_light(kind, rng) for kind in ("noon", "slant", "golden", "overcast", "dusk") for _ in range(8)
    ]


def test_the_sun_stands_where_the_package_computes_it_by_other_equations() -> None:
    for hours in range(0, 5 * 8766, 409):
        time = datetime(2019, 1, 1, tzinfo=UTC) + timedelta(hours=hours)
        elevation, azimuth = sun_at(time)
        assert elevation == pytest.approx(sun_position(time, LATITUDE, LONGITUDE)[0], abs=0.7)
        if abs(azimuth) < 170:
            assert (azimuth > 0) == (sun_position(time, LATITUDE, LONGITUDE)[1] < 0) or abs(azimuth) < 1


def test_a_time_is_one_at_which_the_sun_is_where_the_light_has_it() -> None:
    for light in _lights():
        time = find_time(light.elevation, light.azimuth, 2022, np.random.default_rng(1))
        elevation, azimuth = sun_at(time)
        assert time.year == 2022
        assert elevation == pytest.approx(light.elevation, abs=0.1)
        assert azimuth == pytest.approx(light.azimuth, abs=20)
        assert (azimuth > 0) == (light.azimuth > 0)


@pytest.mark.parametrize(
    ("utc", "hours"),
    [
        (datetime(2021, 3, 28, 0, 59, tzinfo=UTC), 1),
        (datetime(2021, 3, 28, 1, 0, tzinfo=UTC), 2),
        (datetime(2021, 10, 31, 0, 59, tzinfo=UTC), 2),
        (datetime(2021, 10, 31, 1, 0, tzinfo=UTC), 1),
    ],
)
def test_summer_time_begins_and_ends_on_the_last_sundays(utc: datetime, hours: int) -> None:
    assert zone_of(utc) == timedelta(hours=hours)


def test_what_a_clock_says_is_read_back(tmp_path: Path) -> None:
    file, pixels = tmp_path / "a.jpg", np.random.default_rng(0).integers(0, 255, (12, 16, 3), dtype=np.uint8)
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, "JPEG")
    told = 0
    for index in range(40):
        clock = draw_clock(index, MIDDAY, seed=1)
        file.write_bytes(stream.getvalue())
        add_clock(file, index, MIDDAY, seed=1)
        with Image.open(file) as image:
            np.testing.assert_array_equal(np.asarray(image), np.asarray(Image.open(stream)))
        capture = read_capture(file)
        if clock is None:
            assert capture is None
            assert file.read_bytes() == stream.getvalue()
            continue
        assert capture is not None
        assert capture.local == clock.local
        zoned = clock.zone and (clock.local - clock.zone).replace(tzinfo=UTC)
        assert capture.utc == (clock.utc or zoned)
        assert (capture.place is None) == (clock.place is None)
        if clock.place is not None:
            assert capture.place == pytest.approx(clock.place, abs=1e-5)
            told += 1
    assert told > 5


def test_a_block_has_no_focal_length_and_no_orientation() -> None:
    exif = Image.Exif()
    exif.load(exif_block(Clock(datetime(2021, 5, 1, 12), timedelta(hours=2))))
    assert set(exif) == {IFD.Exif}
    assert set(exif.get_ifd(IFD.Exif)) == {Base.DateTimeOriginal, Base.OffsetTimeOriginal}


def test_clocks_do_not_depend_on_the_number_of_photos_but_on_the_seed() -> None:
    first, again, other = (
        [draw_clock(index, MIDDAY, seed) for index in range(10)] for seed in (1, 1, 2)
    )  # fmt: skip
    assert first == again
    assert first != other


def test_right_clocks_tell_the_hour_of_their_light() -> None:
    """Time zone and summer time included: what GPS says and what the clock says are the same time."""
    for index in range(200):
        clock = draw_clock(index, MIDDAY, seed=3)
        if clock is not None and not clock.fault:
            utc = clock.local - zone_of(clock.local.replace(tzinfo=UTC))
            assert sun_at(utc.replace(tzinfo=UTC))[0] == pytest.approx(MIDDAY.elevation, abs=0.1)
            assert clock.zone in (None, clock.local - utc)


def test_faults_are_faults() -> None:
    faults = [clock for index in range(200) if (clock := draw_clock(index, MIDDAY, seed=3)) and clock.fault]
    assert 10 < len(faults) < 25
    assert all(clock.utc is clock.place is clock.zone is None for clock in faults)
    for clock in faults:
        utc = (clock.local - zone_of(clock.local.replace(tzinfo=UTC))).replace(tzinfo=UTC)
        assert "reset" in clock.fault or abs(sun_at(utc)[0] - MIDDAY.elevation) > 5


def test_the_photos_that_ship_are_told_apart_by_what_they_say(tmp_path: Path) -> None:
    scene = write_demo_scene(tmp_path / "scene")
    captures = [read_capture(file) for file in sorted((scene / "images").iterdir())]
    clocks = [draw_clock(index, MIDDAY, seed=0) for index in range(len(captures))]
    assert [each is None for each in captures] == [each is None for each in clocks]
    told = [each for each in captures if each is not None]
    assert len(captures) - len(told) == 8
    assert sum(each.place is not None for each in told) == 14
    assert sum(each.utc is not None for each in told) == 18
    assert sum(bool(clock and clock.fault) for clock in clocks) == 4


@pytest.mark.parametrize(("jpeg", "block"), [(b"GIF89a", b"Exif"), (b"\xff\xd8\xff\xd9", bytes(70_000))])
def test_what_no_segment_holds_is_refused(jpeg: bytes, block: bytes) -> None:
    with pytest.raises(ValueError, match="one segment of a JPEG"):
        with_exif(jpeg, block)
