"""When and where the demo's photos were taken, as their EXIF blocks tell it: some say nothing, and a few are wrong.

The hours are those at which the sun stands where it stood for the render (`demo_generator.ephemeris`). Cameras
write the time of their clock. Newer phones add the time zone, and most of them the position and time by GPS. Photos
from the web have lost their blocks. Some cameras were never set: to the hour of the place, or at all.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, date, datetime, timedelta
from fractions import Fraction
from pathlib import Path

import numpy as np
from PIL import Image
from PIL.ExifTags import GPS, IFD, Base

from demo_generator.ephemeris import LATITUDE, LONGITUDE, find_time
from demo_generator.lighting import Light
from wildgs.scene.capture import with_exif

_FROM_WEB, _PLACED_PHONE, _PHONE, _CAMERA = 0.2, 0.54, 0.66, 0.91
"""Upper bounds of the shares of photos without a block, by phones with and without GPS, and by cameras that are
set; the others are cameras that are not."""

_SPACING = (
    0.41421356237309515  # of square root 2, so that kinds do not follow the order of viewpoints or lights
)
_YEARS = range(2019, 2024)  # phones write time zones by then
_HOMES = (-9, -6, 7, 8)
"""Hours by which the clocks of travellers differ from those of the place."""

_RESET = datetime(2012, 1, 1)
"""Where a camera begins to count that has lost its battery."""

_NEARBY = 4e-4
"""Largest distance of a GPS position from the landmark, degrees: some tens of metres."""


@dataclass(frozen=True)
class Clock:
    """What the camera of a photo says about its time and place.

    Attributes:
        local: Time of the camera's clock.
        zone: Offset of the clock from UTC, if the camera writes it.
        utc: Time by GPS.
        place: Latitude and longitude by GPS, degrees.
        fault: What is wrong with the clock; empty if it is right.
    """

    local: datetime
    zone: timedelta | None = None
    utc: datetime | None = None
    place: tuple[float, float] | None = None
    fault: str = ""


def draw_clock(index: int, light: Light, seed: int) -> Clock | None:
    """What the EXIF block of a photo tells; None for a photo without one.

    Args:
        index: Number of the photo.
        light: Its light.
        seed: Of the scene. The same photo has the same clock in a scene of any size.
    """
    start = np.random.default_rng([seed, 2]).uniform()
    kind = (start + index * _SPACING) % 1.0
    if kind < _FROM_WEB:
        return None
    rng = np.random.default_rng([seed, 2, index])
    utc = find_time(light.elevation, light.azimuth, int(rng.choice(_YEARS)), rng)
    zone = zone_of(utc)
    local = (utc + zone).replace(tzinfo=None)
    if kind < _PLACED_PHONE:
        north, east = rng.uniform(-_NEARBY, _NEARBY, 2)
        return Clock(local, zone, utc, (LATITUDE + north, LONGITUDE + east))
    if kind < _PHONE:
        return Clock(local, zone)
    if kind < _CAMERA:
        return Clock(local)
    if rng.uniform() < 0.5:
        hours = int(rng.choice(_HOMES))
        return Clock(local + timedelta(hours=hours), fault=f"set to another zone, {hours:+d} hours")
    running = timedelta(hours=float(rng.uniform(0, 72)))
    return Clock((_RESET + running).replace(microsecond=0), fault="reset some hours before")


def zone_of(utc: datetime) -> timedelta:
    """Offset of Central European clocks from UTC: one hour, two between the last Sundays of March and October."""
    begin, end = (
        datetime.combine(_last_sunday(utc.year, month), datetime.min.time(), UTC) + timedelta(hours=1)
        for month in (3, 10)
    )
    return timedelta(hours=2 if begin <= utc < end else 1)


def _last_sunday(year: int, month: int) -> date:
    last = date(year, month, 31)
    return last - timedelta(days=(last.weekday() + 1) % 7)


def exif_block(clock: Clock) -> bytes:
    """The EXIF block of a photo: times, time zone and GPS, and nothing about the camera."""
    exif = Image.Exif()
    details = exif.get_ifd(IFD.Exif)
    details[Base.DateTimeOriginal] = f"{clock.local:%Y:%m:%d %H:%M:%S}"
    if clock.zone is not None:
        details[Base.OffsetTimeOriginal] = f"+{clock.zone.seconds // 3600:02d}:00"
    if clock.utc is not None and clock.place is not None:
        latitude, longitude = clock.place
        gps = exif.get_ifd(IFD.GPSInfo)
        gps.update({GPS.GPSLatitudeRef: "N", GPS.GPSLatitude: _sexagesimal(latitude)})
        gps.update({GPS.GPSLongitudeRef: "E", GPS.GPSLongitude: _sexagesimal(longitude)})
        gps[GPS.GPSTimeStamp] = (clock.utc.hour, clock.utc.minute, clock.utc.second)
        gps[GPS.GPSDateStamp] = f"{clock.utc:%Y:%m:%d}"
    return exif.tobytes()


def _sexagesimal(angle: float) -> tuple[Fraction, Fraction, Fraction]:
    """A positive angle in degrees, minutes, and seconds to a hundredth."""
    hundredths = round(angle * 360_000)
    degrees, rest = divmod(hundredths, 360_000)
    minutes, seconds = divmod(rest, 6_000)
    return Fraction(degrees), Fraction(minutes), Fraction(seconds, 100)


def add_clock(photo: Path, index: int, light: Light, seed: int) -> None:
    """Inserts the EXIF block of a photo into its JPEG file, whose other bytes remain as they are."""
    clock = draw_clock(index, light, seed)
    if clock is not None:
        photo.write_bytes(with_exif(photo.read_bytes(), exif_block(clock)))
