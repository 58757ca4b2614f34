"""Position of the sun, accurate to about half a degree, by NOAA's general solar position equations."""

from __future__ import annotations

import math
from datetime import UTC, datetime

from wildgs.scene.capture import Capture

NOON = 90.0
"""Phase of the day at noon."""


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


def phase_of(capture: Capture, place: tuple[float, float] | None = None) -> float:
    """Phase of the day: the sun's elevation before noon, 180 minus the elevation afterwards; degrees.

    If the UTC time or the place is unknown, the phase is computed from the camera's clock: 0 at 6 o'clock, 90 at
    12.

    Args:
        capture: Time and place of a photo.
        place: Latitude and longitude for photos without a place.
    """
    place = capture.place or place
    if capture.utc is None or place is None:
        hour = capture.local.hour + capture.local.minute / 60
        return 15 * (hour if hour >= 3 else hour + 24) - NOON
    elevation, angle = sun_position(capture.utc, *place)
    return elevation if angle < 0 else 180 - elevation
