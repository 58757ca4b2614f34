"""Copies capture time and GPS position of photos to copies of them."""

from __future__ import annotations

import struct
from pathlib import Path

from PIL import Image
from PIL.ExifTags import IFD, Base

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
        size = struct.pack(">H", len(block) + 2)
        target.write_bytes(b"".join([_START, _EXIF_SEGMENT, size, block, content[len(_START) :]]))
