"""Capture time and place of photos in EXIF data: reading them, and copying them to other files."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from PIL import Image
from PIL.ExifTags import GPS, IFD, Base

from wildgs.scene.images import open_image

_START = b"\xff\xd8"
_EXIF_SEGMENT = b"\xff\xe1"
_MOST_BYTES = 0xFFFF - 2
_TIMES = (
    Base.DateTimeOriginal,
    Base.DateTimeDigitized,
    Base.OffsetTime,
    Base.OffsetTimeOriginal,
    Base.OffsetTimeDigitized,
)


def carry_capture(source: Path, target: Path) -> None:
    """Copies times and GPS position from a photo's EXIF data to a JPEG file, if there are any.

    The pixels are not encoded again; the EXIF segment is inserted before the others. Focal length and orientation
    are not copied, since copies are undistorted and upright.
    """
    try:
        with Image.open(source) as image:
            exif = image.getexif()
        kept = Image.Exif()
        times = exif.get_ifd(IFD.Exif)
        kept.get_ifd(IFD.Exif).update({tag: times[tag] for tag in _TIMES if tag in times})
        kept.get_ifd(IFD.GPSInfo).update(exif.get_ifd(IFD.GPSInfo))
        if not any(kept.get_ifd(block) for block in (IFD.Exif, IFD.GPSInfo)):
            return
        block = kept.tobytes()
    except Exception:  # invalid EXIF data is ignored
        return
    content = target.read_bytes()
    if content.startswith(_START) and len(block) <= _MOST_BYTES:
        target.write_bytes(with_exif(content, block))


def with_exif(jpeg: bytes, block: bytes) -> bytes:
    """Inserts an EXIF block before all other segments of a JPEG file, without encoding the pixels again.

    Args:
        jpeg: A JPEG file without an EXIF block.
        block: As `PIL.Image.Exif.tobytes` returns it.

    Raises:
        ValueError: The file is no JPEG, or the block is longer than a segment.
    """
    if not jpeg.startswith(_START) or len(block) > _MOST_BYTES:
        raise ValueError("an EXIF block must fit into one segment of a JPEG file")
    size = struct.pack(">H", len(block) + 2)
    return b"".join([_START, _EXIF_SEGMENT, size, block, jpeg[len(_START) :]])


_TIME = "%Y:%m:%d %H:%M:%S"
_PNG_BLOCKS = {"exif", "Raw profile type exif"}


@dataclass(frozen=True)
class Capture:
    """Time and place of a photo.

    Attributes:
        local: Local time of the camera's clock, without time zone.
        utc: Time in UTC, by GPS or by a clock with a known time zone; None if unknown.
        place: Latitude and longitude, degrees; None if unknown.
    """

    local: datetime
    utc: datetime | None = None
    place: tuple[float, float] | None = None


def read_capture(file: Path) -> Capture | None:
    """Reads the EXIF data of a photo; None if it is missing or invalid."""
    try:
        with open_image(file) as image:
            if image.format == "PNG" and not image.info.keys() & _PNG_BLOCKS:
                return None  # Pillow would decode all pixels to search for EXIF data after them
            exif = image.getexif()
            details, gps = exif.get_ifd(IFD.Exif), exif.get_ifd(IFD.GPSInfo)
        # Not `DateTime`, which is the time of the last change of the file.
        stamp = details.get(Base.DateTimeOriginal) or details.get(Base.DateTimeDigitized)
        local = datetime.strptime(str(stamp).strip("\0 "), _TIME)
        return Capture(local, _utc(gps) or _zoned(local, details), read_place(gps))
    except Exception:  # EXIF data of photos from the internet may be malformed in any way
        return None


def _utc(gps: dict) -> datetime | None:
    """The time of the GPS receiver."""
    try:
        hours, minutes, seconds = (float(part) for part in gps[GPS.GPSTimeStamp])
        day = datetime.strptime(str(gps[GPS.GPSDateStamp]).strip("\0 "), "%Y:%m:%d").replace(tzinfo=UTC)
        return day.replace(hour=int(hours), minute=int(minutes), second=int(seconds))
    except (KeyError, TypeError, ValueError, OverflowError):
        return None


def _zoned(local: datetime, details: dict) -> datetime | None:
    """The time of the camera's clock, if it has a time zone such as `+02:00`."""
    zone = details.get(Base.OffsetTimeOriginal) or details.get(Base.OffsetTime)
    try:
        return datetime.fromisoformat(f"{local.isoformat()}{str(zone).strip(chr(0) + ' ')}").astimezone(UTC)
    except (ValueError, OverflowError):
        return None


def read_place(gps: dict) -> tuple[float, float] | None:
    """Latitude and longitude in degrees from the GPS entries of EXIF data; None if missing or invalid."""
    try:
        latitude, longitude = (
            sum(float(part) / 60**power for power, part in enumerate(gps[tag]))
            * {high: 1, low: -1}[gps[ref].strip("\0 ").upper()]
            for tag, ref, high, low in (
                (GPS.GPSLatitude, GPS.GPSLatitudeRef, "N", "S"),
                (GPS.GPSLongitude, GPS.GPSLongitudeRef, "E", "W"),
            )
        )
    except (KeyError, TypeError, ValueError, AttributeError, ZeroDivisionError):
        return None
    valid = abs(latitude) <= 90 and abs(longitude) <= 180 and (latitude, longitude) != (0.0, 0.0)
    return (latitude, longitude) if valid else None
