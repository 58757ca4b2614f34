"""Position of the sun, accurate to about half a degree, by NOAA's general solar position equations."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime, timedelta
from statistics import median, median_low

from wildgs.scene.capture import Capture

NOON = 90.0
"""Phase of the day at noon."""

_QUARTER, _LARGEST_ZONE = timedelta(minutes=15), timedelta(hours=14)
_NEIGHBOURS = 5
"""Number of clocks with a known time zone, those nearest in the year, that vote on the zone of another clock."""


def sun_position(utc: datetime, latitude: float, longitude: float) -> tuple[float, float]:
    """Elevation and hour angle of the sun (0 at noon, negative before) in degrees."""
    utc = utc.astimezone(UTC)
    hours = utc.hour + utc.minute / 60 + utc.second / 3600
    year = 2 * math.pi / 365.25 * (utc.timetuple().tm_yday - 1 + (hours - 12) / 24)
    minutes = 229.18 * (
        0.000075
        + 0.001868 * math.cos(year)
        - 0.032077 * math.sin(year)
        - 0.014615 * math.cos(2 * year)
        - 0.040849 * math.sin(2 * year)
    )
    declination = (
        0.006918
        - 0.399912 * math.cos(year)
        + 0.070257 * math.sin(year)
        - 0.006758 * math.cos(2 * year)
        + 0.000907 * math.sin(2 * year)
        - 0.002697 * math.cos(3 * year)
        + 0.00148 * math.sin(3 * year)
    )
    angle = (15 * hours + minutes / 4 + longitude - 180 + 180) % 360 - 180
    place = math.radians(latitude)
    height = math.sin(place) * math.sin(declination) + math.cos(place) * math.cos(declination) * math.cos(
        math.radians(angle)
    )
    return math.degrees(math.asin(max(-1.0, min(1.0, height)))), angle


def phases_of(captures: Mapping[str, Capture]) -> dict[str, float]:
    """Phases of the day of photos of one place: the sun's elevation before noon, 180 minus the elevation after.

    If any photo tells the place, the sun's position is computed for all of them. A clock without a time zone is
    taken to be in that of the photos of the same season that have one, so that summer time is right, or else in
    that of the place's longitude. If no photo tells the place, all phases are those of the cameras' clocks: 0 at
    6 o'clock, 90 at 12.

    Args:
        captures: Times and places of photos, by name.

    Returns:
        Degrees, -90 to 270, by name; photos with an impossible date have none.
    """
    places = [capture.place for capture in captures.values() if capture.place is not None]
    if not places:
        return {name: _clock_phase(capture.local) for name, capture in captures.items()}
    place = (median(latitude for latitude, _ in places), _middle_longitude([each for _, each in places]))
    zones = [(capture.local, zone) for capture in captures.values() if (zone := _zone(capture)) is not None]
    phases = {}
    for name, capture in captures.items():
        try:
            utc = capture.utc or (capture.local - _likely_zone(capture.local, zones, place[1])).replace(
                tzinfo=UTC
            )
        except OverflowError:  # a clock in the first or last hours that dates can express
            continue
        elevation, angle = sun_position(utc, *place)
        phases[name] = elevation if angle < 0 else 180 - elevation
    return phases


def _clock_phase(local: datetime) -> float:
    hour = local.hour + local.minute / 60
    return 15 * (hour if hour >= 3 else hour + 24) - NOON


def _middle_longitude(longitudes: Sequence[float]) -> float:
    """The median, also across the date line."""
    first = longitudes[0]
    return first + median((each - first + 180) % 360 - 180 for each in longitudes)


def _zone(capture: Capture) -> timedelta | None:
    """How far a clock is ahead of UTC, to a quarter of an hour; None if that is unknown, or no time zone."""
    if capture.utc is None:
        return None
    ahead = round((capture.local - capture.utc.replace(tzinfo=None)) / _QUARTER) * _QUARTER
    return ahead if abs(ahead) <= _LARGEST_ZONE else None


def _likely_zone(local: datetime, zones: Sequence[tuple[datetime, timedelta]], longitude: float) -> timedelta:
    """The median zone of the clocks that were read at nearly the same time of the year."""
    if not zones:
        return timedelta(hours=round(((longitude + 180) % 360 - 180) / 15))
    day = local.timetuple().tm_yday

    def distance(other: tuple[datetime, timedelta]) -> int:
        days = abs(other[0].timetuple().tm_yday - day)
        return min(days, 366 - days)

    return median_low(zone for _, zone in sorted(zones, key=distance)[:_NEIGHBOURS])
