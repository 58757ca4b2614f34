"""When the sun stands where a photo's light says, at the place of the demo's landmark.

Position of the sun by the low-precision formula of the Astronomical Almanac (Michalsky 1988, Solar Energy 40(3)),
accurate to 0.01 degrees. The package computes it by other equations (`wildgs.light.sun`), so that a mistake in
either shows.
"""

from __future__ import annotations

import math
from datetime import UTC, date, datetime, timedelta

import numpy as np

LATITUDE, LONGITUDE = 47.0, 10.0
"""The landmark's place, degrees. At this latitude the sun comes closest, over a year, to the positions that
`demo_generator.lighting.draw_light` draws; its front looks south."""

_EPOCH = datetime(2000, 1, 1, 12, tzinfo=UTC)
_SIMILAR = 1.0
"""Dates whose error in azimuth exceeds that of the best date by at most this number of degrees are candidates."""


def sun_at(time: datetime) -> tuple[float, float]:
    """Elevation of the sun, and its azimuth from the south, positive in the morning, in degrees."""
    declination, transit = _declination_and_transit(time)
    minutes = time.hour * 60 + time.minute + time.second / 60
    hour_angle = (minutes / 4 + LONGITUDE - transit + 180) % 360 - 180
    return _elevation_and_azimuth(declination, hour_angle)


def find_time(elevation: float, azimuth: float, year: int, rng: np.random.Generator) -> datetime:
    """A time (UTC) at which the sun has an elevation, on a date on which its azimuth is nearly the given one.

    Lights draw elevation and azimuth independently, so that some pairs occur on no date: the elevation is exact.

    Args:
        elevation: Degrees above the horizon.
        azimuth: Degrees from the south, positive in the morning.
        year: Of the date.
        rng: Chooses one of the dates.
    """
    days = [date(year, 1, 1) + timedelta(days=number) for number in range(365)]
    times = {day: time for day in days if (time := _time_on(day, elevation, before_noon=azimuth > 0))}
    errors = {day: abs(sun_at(time)[1] - azimuth) for day, time in times.items()}
    least = min(errors.values())
    candidates = [day for day, error in errors.items() if error <= least + _SIMILAR]
    return times[candidates[int(rng.integers(len(candidates)))]]


def _time_on(day: date, elevation: float, *, before_noon: bool) -> datetime | None:
    """When the sun has the elevation on a date; None if it does not."""
    midnight = datetime(day.year, day.month, day.day, tzinfo=UTC)
    time = midnight + timedelta(hours=12)
    place, height = math.radians(LATITUDE), math.radians(elevation)
    for _ in range(3):  # declination and transit change during the day
        declination, transit = _declination_and_transit(time)
        lean = math.radians(declination)
        cosine = (math.sin(height) - math.sin(place) * math.sin(lean)) / (math.cos(place) * math.cos(lean))
        if abs(cosine) > 1.0:
            return None
        hour_angle = math.degrees(math.acos(cosine)) * (-1 if before_noon else 1)
        time = midnight + timedelta(minutes=4 * (hour_angle - LONGITUDE + transit))
    return time.replace(microsecond=0)


def _declination_and_transit(time: datetime) -> tuple[float, float]:
    """Declination of the sun, and the hour angle of Greenwich's mean midnight at its transit, degrees."""
    days = (time - _EPOCH).total_seconds() / 86400
    mean = 280.460 + 0.9856474 * days
    anomaly = math.radians(357.528 + 0.9856003 * days)
    longitude = math.radians(mean + 1.915 * math.sin(anomaly) + 0.020 * math.sin(2 * anomaly))
    tilt = math.radians(23.439 - 0.0000004 * days)
    ascension = math.degrees(math.atan2(math.cos(tilt) * math.sin(longitude), math.cos(longitude)))
    declination = math.degrees(math.asin(math.sin(tilt) * math.sin(longitude)))
    equation_of_time = (mean - ascension + 180) % 360 - 180
    return declination, 180 - equation_of_time


def _elevation_and_azimuth(declination: float, hour_angle: float) -> tuple[float, float]:
    place, lean, angle = (math.radians(value) for value in (LATITUDE, declination, hour_angle))
    up = math.sin(place) * math.sin(lean) + math.cos(place) * math.cos(lean) * math.cos(angle)
    south = math.sin(place) * math.cos(lean) * math.cos(angle) - math.cos(place) * math.sin(lean)
    east = -math.cos(lean) * math.sin(angle)
    return math.degrees(math.asin(up)), math.degrees(math.atan2(east, south))
