"""The order of a day: by the sun, by light, and with clocks that are wrong."""

from __future__ import annotations

import os
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from PIL.ExifTags import GPS, IFD, Base
from PIL.PngImagePlugin import PngImageFile
from scipy.stats import kendalltau

from wildgs.light.day import KEYS, LEAST_PHOTOS, Pattern, plan_day
from wildgs.light.sun import phases_of, sun_position
from wildgs.scene.capture import Capture, read_capture

BERLIN = (52.5163, 13.3777)


@pytest.mark.parametrize(
    ("utc", "place", "elevation"),
    [
        # Overhead at the equator at equinox; 90 - latitude + 23.44 degrees high at noon of the solstice.
        (datetime(2024, 3, 20, 12, 7, tzinfo=UTC), (0.0, 0.0), 90.0),
        (datetime(2024, 6, 20, 12, 2, tzinfo=UTC), (51.4769, 0.0), 90 - 51.4769 + 23.44),
        (datetime(2024, 12, 21, 11, 58, tzinfo=UTC), (51.4769, 0.0), 90 - 51.4769 - 23.44),
        (datetime(2024, 6, 20, 23, 58, tzinfo=UTC), (90.0, 0.0), 23.44),
    ],
)
def test_the_sun_stands_where_almanacs_say(utc: datetime, place: tuple, elevation: float) -> None:
    assert sun_position(utc, *place)[0] == pytest.approx(elevation, abs=0.5)


def test_the_sun_rises_before_noon_and_sets_after_it() -> None:
    day = datetime(2024, 5, 1, tzinfo=UTC)
    captures = {
        str(hour): Capture(day.replace(tzinfo=None), day + timedelta(hours=hour), BERLIN)
        for hour in range(1, 23)
    }
    phases = list(phases_of(captures).values())
    assert phases == sorted(phases)
    assert phases[0] < 0
    assert phases[-1] > 170


def test_a_clock_without_place_counts_from_six_to_six() -> None:
    hours = {6: 0.0, 12: 90.0, 18: 180.0, 1: 285.0}
    assert phases_of({str(hour): Capture(datetime(2019, 7, 1, hour, 0)) for hour in hours}) == {
        str(hour): phase for hour, phase in hours.items()
    }


def _zoned(local: datetime, hours: int, place: tuple[float, float] | None = None) -> Capture:
    return Capture(local, (local - timedelta(hours=hours)).replace(tzinfo=UTC), place)


def _phase(utc: datetime) -> float:
    elevation, angle = sun_position(utc.replace(tzinfo=UTC), *BERLIN)
    return elevation if angle < 0 else 180 - elevation


def test_one_place_gives_clocks_of_all_seasons_their_sun() -> None:
    """Clocks without a time zone have that of the others at this time of the year, summer time included."""
    captures = {
        "placed": _zoned(datetime(2020, 6, 10, 9), 2, BERLIN),
        **{f"summer {day}": _zoned(datetime(2021, 7, day, 9), 2) for day in (1, 2, 3)},
        **{f"winter {day}": _zoned(datetime(2019, 1, day, 9), 1) for day in (1, 2, 3, 4)},
        "clock in summer": Capture(datetime(2015, 7, 9, 20)),
        "clock in winter": Capture(datetime(2016, 12, 28, 20)),
    }
    phases = phases_of(captures)
    assert list(phases) == list(captures)
    assert phases["placed"] == pytest.approx(_phase(datetime(2020, 6, 10, 7)))
    assert phases["summer 1"] == pytest.approx(_phase(datetime(2021, 7, 1, 7)))
    assert phases["clock in summer"] == pytest.approx(_phase(datetime(2015, 7, 9, 18)))
    assert phases["clock in winter"] == pytest.approx(_phase(datetime(2016, 12, 28, 19)))


def test_clocks_without_any_zone_have_that_of_the_longitude() -> None:
    captures = {"placed": Capture(datetime(2020, 1, 10, 9), None, BERLIN)}
    assert phases_of(captures)["placed"] == pytest.approx(_phase(datetime(2020, 1, 10, 8)))


def test_what_is_no_time_zone_sets_no_clock() -> None:
    """A camera whose clock was reset still writes the right time by GPS."""
    reset = Capture(datetime(2000, 1, 1), datetime(2020, 1, 10, 8, tzinfo=UTC), BERLIN)
    phases = phases_of({"reset": reset, "clock": Capture(datetime(2020, 1, 10, 9))})
    assert phases["reset"] == phases["clock"] == pytest.approx(_phase(datetime(2020, 1, 10, 8)))


@pytest.mark.parametrize("year", [1, 9999])
def test_dates_at_the_end_of_time_have_no_sun(year: int) -> None:
    far = Capture(datetime(year, *((1, 1) if year == 1 else (12, 31)), 23 if year > 1 else 0))
    west = _zoned(datetime(2020, 1, 1, 9), 1 if year == 1 else -8, BERLIN)
    assert list(phases_of({"far": far, "known": west})) == ["known"]


def test_the_middle_of_places_at_the_date_line_is_there() -> None:
    noon = datetime(2020, 3, 20, 0, tzinfo=UTC)
    captures = {
        str(longitude): Capture(datetime(2020, 3, 20, 12), noon, (0.0, longitude))
        for longitude in (179.9, -179.9, 179.8)
    }
    assert all(phase == pytest.approx(90, abs=4) for phase in phases_of(captures).values())


def _photo(file: Path) -> Path:
    exif = Image.Exif()
    exif.get_ifd(IFD.Exif).update(
        {Base.DateTimeOriginal: "2019:07:01 19:30:00", Base.OffsetTimeOriginal: "+02:00"}
    )
    gps = {GPS.GPSLatitudeRef: "N", GPS.GPSLatitude: (52.0, 30.0, Fraction(3600, 100)),
           GPS.GPSLongitudeRef: "W", GPS.GPSLongitude: (13.0, 15.0, 0.0)}  # fmt: skip
    exif.get_ifd(IFD.GPSInfo).update(gps)
    Image.new("RGB", (8, 6)).save(file, exif=exif)
    return file


def test_time_zone_and_place_are_read(tmp_path: Path) -> None:
    capture = read_capture(_photo(tmp_path / "a.jpg"))
    assert capture is not None
    assert capture.local == datetime(2019, 7, 1, 19, 30)
    assert capture.utc == datetime(2019, 7, 1, 17, 30, tzinfo=UTC)
    assert capture.place == pytest.approx((52.51, -13.25))


@pytest.mark.parametrize("content", [b"", b"no picture", b"\xff\xd8\xff\xe1\x00\x10Exif\x00\x00broken"])
def test_files_without_a_time_have_none(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.jpg").write_bytes(content)
    assert read_capture(tmp_path / "a.jpg") is None
    Image.new("RGB", (4, 4)).save(tmp_path / "b.jpg")
    assert read_capture(tmp_path / "b.jpg") is None
    assert read_capture(tmp_path / "nothing.jpg") is None


def _with_blocks(file: Path, **tags: dict) -> Path:
    exif = Image.Exif()
    exif.get_ifd(IFD.Exif)[Base.DateTimeOriginal] = "2019:07:01 19:30:00"
    for block, values in tags.items():
        exif.get_ifd(getattr(IFD, block)).update(values)
    Image.new("RGB", (8, 6)).save(file, exif=exif.tobytes())
    return file


@pytest.mark.parametrize(
    "gps",
    [
        {GPS.GPSLatitudeRef: "", GPS.GPSLatitude: (52.0, 30.0, 0.0)},
        {GPS.GPSLatitudeRef: "N", GPS.GPSLatitude: (1e9, 0.0, 0.0)},
        {GPS.GPSTimeStamp: (99.0, 99.0, 99.0), GPS.GPSDateStamp: "2019:07:01"},
        {GPS.GPSTimeStamp: (1.0, 1.0, 1.0), GPS.GPSDateStamp: "0000:00:00"},
    ],
)
def test_absurd_places_and_clocks_are_not_known(tmp_path: Path, gps: dict) -> None:
    east = {GPS.GPSLongitudeRef: "E", GPS.GPSLongitude: (13.0, 15.0, 0.0)}
    capture = read_capture(_with_blocks(tmp_path / "a.jpg", GPSInfo=gps | east))
    assert capture == Capture(datetime(2019, 7, 1, 19, 30))


@pytest.mark.parametrize("stamp", ["0000:00:00 00:00:00", "2019:13:45 25:61:00", "  ", "0001:01:01 00:00:00"])
def test_absurd_times_are_no_times(tmp_path: Path, stamp: str) -> None:
    details = {Base.DateTimeOriginal: stamp, Base.OffsetTimeOriginal: "+23:00"}
    capture = read_capture(_with_blocks(tmp_path / "a.jpg", Exif=details))
    assert capture is None or capture.utc is None


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes here")
def test_a_pipe_has_no_time(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a.jpg")
    assert read_capture(tmp_path / "a.jpg") is None


def test_pictures_without_a_block_are_not_decoded_for_it(tmp_path: Path, monkeypatch) -> None:
    """Pillow looks for it behind the pixels: a PNG of 240 megapixels in 233 kB took gigabytes."""
    Image.new("RGB", (8, 6)).save(tmp_path / "a.png")
    monkeypatch.setattr(PngImageFile, "load", lambda *_: pytest.fail("decoded"))
    assert read_capture(tmp_path / "a.png") is None
    monkeypatch.undo()
    assert read_capture(_with_blocks(tmp_path / "b.png")) is not None


def _world(photos: int = 40, seed: int = 0) -> tuple[dict[str, Pattern], dict[str, float]]:
    """A box under a sun that rises on one side: lit by its height and side, with exposures at random."""
    rng, estimates = np.random.default_rng(seed), np.random.default_rng(seed + 1)
    normals = rng.normal(size=(500, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    albedo = rng.uniform(0.2, 0.9, 500)
    patterns, phases, suns = {}, {}, []
    for number in range(photos):
        phase = rng.uniform(2, 178)
        height = np.radians(min(phase, 180 - phase))
        side = -np.cos(height) if phase < 90 else np.cos(height)
        lit = np.clip(normals @ np.array([side, 0.0, np.sin(height)]), 0, None)
        light = 0.3 * np.array([0.9, 1, 1.2]) + lit[:, None] * np.sin(height) ** 0.3 * np.array(
            [1.2, 1.0, 0.3 + 0.6 * np.sin(height)]
        )
        color = albedo[:, None] * light * np.exp(rng.normal(0, 0.3))
        log = np.log(color @ np.array([0.2126, 0.7152, 0.0722]))
        log += rng.normal(0, 0.05, 500)
        name = f"{number}.jpg"
        # South is +y, so that the sun rises in -x and is on the left in the morning, as seen by who looks at it.
        sun = np.array([side, 0.3, np.sin(height)]) + estimates.normal(0, 0.3, 3)
        patterns[name] = Pattern(log - log.mean(), np.log(color[:, 0] / color[:, 2]))
        suns.append(sun)
        phases[name] = phase
    return patterns, phases, np.array(suns)


def _tau(phases: dict[str, float], truth: dict[str, float]) -> float:
    return kendalltau(list(phases.values()), [truth[name] for name in phases])[0]


def test_photos_are_ordered_by_their_times_and_wrong_clocks_are_named() -> None:
    patterns, truth, suns = _world()
    wrong = sorted(truth, key=lambda name: abs(truth[name] - 90))[:3] + sorted(truth, key=truth.get)[:2]
    told = truth | dict.fromkeys(wrong[:3], -20.0) | dict.fromkeys(wrong[3:], 88.0)
    day = plan_day(patterns, told, suns)
    assert day is not None
    assert day.by_time
    assert not day.untimed
    assert set(day.left_out) >= set(wrong)
    assert len(day.left_out) <= len(wrong) + 2
    assert list(day.phases.values()) == sorted(day.phases.values())
    assert _tau(day.phases, truth) > 0.99
    assert not set(day.keys) & set(wrong)


@pytest.mark.parametrize("share", [0.25, 0.5, 0.8])
def test_photos_without_a_time_are_placed_between_the_others_by_their_light(share: float) -> None:
    patterns, truth, suns = _world()
    told = {name: phase for number, (name, phase) in enumerate(truth.items()) if number * share % 1 < share}
    day = plan_day(patterns, told, suns)
    assert day is not None
    assert day.by_time
    assert set(day.phases) == set(truth)
    assert set(day.untimed) == set(truth) - set(told)
    assert all(day.phases[name] == pytest.approx(phase, abs=0.01) for name, phase in told.items())
    assert _tau(day.phases, truth) > 0.95
    heights = np.array(
        [[90 - abs(90 - phases[name]) for phases in (day.phases, truth)] for name in day.untimed]
    )
    assert np.median(np.abs(heights[:, 0] - heights[:, 1])) < 5


def test_south_of_the_tropics_times_tell_which_side_the_morning_is() -> None:
    patterns, truth, suns = _world()
    suns = suns * [-1.0, 1.0, 1.0]
    told = {name: phase for number, (name, phase) in enumerate(truth.items()) if number % 2}
    day = plan_day(patterns, told, suns)
    assert day is not None
    assert np.mean([(truth[name] < 90) == (day.phases[name] < 90) for name in day.untimed]) > 0.85


def test_without_times_light_alone_finds_the_height_of_the_sun() -> None:
    patterns, truth, suns = _world()
    day = plan_day(patterns, {}, suns)
    assert day is not None
    assert not day.by_time
    heights = [90 - abs(phase - 90) for phase in day.phases.values()]
    tau = kendalltau(heights, [90 - abs(truth[name] - 90) for name in day.phases])[0]
    assert tau > 0.8
    assert np.mean([(truth[name] < 90) == (phase < 90) for name, phase in day.phases.items()]) > 0.9


def test_contrast_of_cameras_does_not_change_the_order() -> None:
    patterns, _, suns = _world()
    mean, rng = (
        np.mean([pattern.luminance for pattern in patterns.values()], axis=0),
        np.random.default_rng(4),
    )
    curved = {
        name: replace(pattern, luminance=pattern.luminance + rng.normal(0, 0.3) * (mean + mean**2))
        for name, pattern in patterns.items()
    }
    # The mean of all patterns is the same, so that what is explained by it is the same.
    shift = np.mean([pattern.luminance for pattern in curved.values()], axis=0) - mean
    curved = {name: replace(each, luminance=each.luminance - shift) for name, each in curved.items()}
    one, other = (plan_day(given, {}, suns) for given in (patterns, curved))
    assert one is not None
    assert other is not None
    heights = [[90 - abs(day.phases[name] - 90) for name in patterns] for day in (one, other)]
    assert kendalltau(*heights)[0] > 0.9


def test_times_that_say_nothing_about_the_light_are_not_believed() -> None:
    patterns, _, suns = _world()
    rng = np.random.default_rng(3)
    day = plan_day(patterns, {name: float(rng.uniform(0, 180)) for name in patterns}, suns)
    assert day is not None
    assert not day.by_time
    assert not day.left_out


def test_keys_are_few_in_order_and_reach_from_end_to_end() -> None:
    patterns, truth, suns = _world()
    day = plan_day(patterns, truth, suns)
    assert day is not None
    phases = [day.phases[key] for key in day.keys]
    assert phases == sorted(phases)
    assert LEAST_PHOTOS <= len(phases) <= KEYS
    assert phases[0] < 30
    assert phases[-1] > 150


def test_a_few_photos_have_no_day() -> None:
    patterns, _, suns = _world(LEAST_PHOTOS - 1)
    assert plan_day(patterns, {}, suns) is None
