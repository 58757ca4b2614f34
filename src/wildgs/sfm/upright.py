"""Working copies of photos that every later step can read: upright, 8-bit, with plain names."""

from __future__ import annotations

import hashlib
import shutil
import unicodedata
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath, PureWindowsPath

from PIL import Image

from wildgs.errors import UserError, WildGSWarning
from wildgs.files import is_file, is_unprintable, printable
from wildgs.progress import Counter, in_threads
from wildgs.scene.colmap import describe_names
from wildgs.scene.config import MAX_IMAGE_PIXELS
from wildgs.scene.images import (
    EXIF_ORIENTATION,
    UnreadableImageError,
    decoding,
    open_image,
    read_photo,
)

SUFFIXES = {
    ".jpg", ".jpeg", ".jpe", ".jfif", ".mpo", ".png", ".tif", ".tiff", ".webp", ".bmp", ".gif",
    ".jp2", ".j2k", ".jpx", ".ppm", ".pgm", ".pnm", ".heic", ".heif", ".avif",
}  # fmt: skip
"""File names of photos; files without an ending are photos if they begin like one."""
MAX_NAME_BYTES = 240
"""Of a photo's name in the scene: masks add an ending to it, and file systems take 255 bytes."""
JPEG_QUALITY = 97
EXIF_IFD, GPS_IFD = 0x8769, 0x8825
COPIERS = 4
"""Threads that decode and copy; Pillow works without Python's lock."""


@dataclass(frozen=True)
class WorkingCopy:
    """A photo as structure from motion reads it.

    Attributes:
        name: Path of the original within the folder of photos.
        work_name: File name of the copy: digits only, because COLMAP's pair lists end a name at a space.
        scene_name: Path of the photo in the scene: the original's, as .jpg, without characters that COLMAP models
            or other systems cannot hold; unique by its stem.
        masked: Whether the photo's transparent pixels were written as a mask beside the copy.
        position: Latitude and longitude by GPS in degrees, None where the photo carries none.
    """

    name: str
    work_name: str
    scene_name: str
    masked: bool
    position: tuple[float, float] | None = None


def list_photos(folder: Path) -> list[str]:
    """Photos in a folder and its sub-folders, as sorted paths relative to it; hidden files are skipped.

    A warning names the files that are not taken for photos.

    Raises:
        UserError: There is no such folder, or no photo in it.
    """
    if not folder.is_dir():
        raise UserError(f"{folder}: no such folder; give the folder that holds the photos")
    names, others = [], []
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if any(part.startswith(".") for part in PurePosixPath(name).parts) or path.is_dir():
            continue
        (names if is_file(path) and _is_photo(path) else others).append(name)
    if not names:
        raise UserError(f"{folder}: no photos (.jpg, .png, .tif, .webp, ...) in this folder; give another")
    if others:
        warnings.warn(
            f"{folder}: {len(others)} files are not photos by their names and are not used:"
            f" {describe_names([printable(name) for name in others])}",
            WildGSWarning,
            stacklevel=2,
        )
    return names


def _is_photo(path: Path) -> bool:
    if path.suffix:
        return path.suffix.lower() in SUFFIXES
    try:
        open_image(path).close()
    except UnreadableImageError:
        return False
    return True


def scene_names(names: Sequence[str]) -> list[str]:
    r"""For each photo a name in the scene: as JPEG, no two with one stem (masks and depth go by stems).

    Names that COLMAP models cannot hold (bytes that are not UTF-8, control characters), that other systems take for
    something else (`\`, drives) or that are too long are replaced by similar ones.
    """
    taken: set[str] = set()
    result = []
    for name in names:
        path = PurePosixPath(*(_safe_part(part) for part in PurePosixPath(name).parts))
        stem = path.stem
        if _folded(path.with_name(stem)) in taken:
            stem = f"{path.stem}_{path.suffix[1:].lower()}"
        number = 2
        while _folded(path.with_name(stem)) in taken:
            stem, number = f"{path.stem}_{path.suffix[1:].lower()}_{number}", number + 1
        taken.add(_folded(path.with_name(stem)))
        jpeg = path.suffix.lower() in (".jpg", ".jpeg") and stem == path.stem
        result.append(str(path if jpeg else path.with_name(f"{stem}.jpg")))
    return result


def _folded(path: PurePosixPath) -> str:
    """A name as file systems compare it that ignore case and how accents are composed."""
    return unicodedata.normalize("NFC", unicodedata.normalize("NFC", str(path)).casefold())


def _safe_part(part: str) -> str:
    """A file or folder name that every part of a scene can hold; most names stay as they are."""
    safe = "".join("_" if is_unprintable(c) or c == "\\" else c for c in part)
    if PureWindowsPath(safe).drive:
        safe = safe.replace(":", "_", 1)
    if len(safe.encode()) <= MAX_NAME_BYTES - 16:  # room for endings that keep names apart
        return safe
    digest = hashlib.sha256(part.encode("utf-8", "surrogateescape")).hexdigest()[:12]
    ending = PurePosixPath(safe).suffix if len(PurePosixPath(safe).suffix) < 8 else ""
    start = safe.encode()[: MAX_NAME_BYTES - 16 - len(digest) - len(ending.encode()) - 1]
    return f"{start.decode(errors='ignore')}-{digest}{ending}"


def copy_upright(
    folder: Path,
    images_dir: Path,
    masks_dir: Path,
    *,
    max_pixels: int = MAX_IMAGE_PIXELS,
    progress: Counter | None = None,
) -> tuple[list[WorkingCopy], dict[str, str]]:
    """Write upright 8-bit JPEG copies of all photos; the EXIF block (focal length, GPS) goes along.

    Args:
        folder: The photos.
        images_dir: Where the copies go; made if missing.
        masks_dir: Where masks of transparent pixels go, named as COLMAP wants them (`<copy>.png`, 0 =
            ignore).
        max_pixels: Larger photos are left out.
        progress: Called with (photos copied, photos in all).

    Returns:
        The copies, and the photos that could not be read with the reason (a warning names them, too).

    Raises:
        UserError: There are no photos.
    """
    names = list_photos(folder)
    images_dir.mkdir(parents=True, exist_ok=True)
    plans = [(n, f"{i:06d}.jpg", s) for i, (n, s) in enumerate(zip(names, scene_names(names), strict=True))]

    def copy(plan: tuple[str, str, str]) -> WorkingCopy | str:
        name, work_name, scene_name = plan
        try:
            masked, position = _copy_one(folder / name, images_dir / work_name, masks_dir, max_pixels)
        except UnreadableImageError as error:
            return str(error)
        return WorkingCopy(name, work_name, scene_name, masked, position)

    copies, broken = [], {}
    for name, result in zip(names, in_threads(copy, plans, COPIERS, progress), strict=True):
        if isinstance(result, str):
            broken[name] = result
            text = f"{printable(str(folder / name))}: {result}; the photo is left out"
            warnings.warn(text, WildGSWarning, stacklevel=2)
        else:
            copies.append(result)
    return copies, broken


def _copy_one(
    source: Path, target: Path, masks_dir: Path, max_pixels: int
) -> tuple[bool, tuple[float, float] | None]:
    """Copy one photo; whether a mask was written, and where the photo was taken."""
    with open_image(source, max_pixels) as image, decoding(image):
        photo = read_photo(source, max_pixels=max_pixels)
        position = gps_position(image)
        if image.format == "JPEG" and image.mode == "RGB" and _orientation(image) == 1:
            shutil.copyfile(source, target)  # as it is: encoding it again would lose a little
            return False, position
        save_jpeg(Image.fromarray(photo.pixels), image, target)
        if photo.mask is None or photo.mask.all():
            return False, position
        masks_dir.mkdir(parents=True, exist_ok=True)
        Image.fromarray(photo.mask).save(masks_dir / f"{target.name}.png")
    return True, position


def gps_position(image: Image.Image) -> tuple[float, float] | None:
    """Latitude and longitude in degrees from the EXIF block; None where it has none that makes sense.

    COLMAP reads positions, too, but only those with an altitude.
    """
    try:
        gps = image.getexif().get_ifd(GPS_IFD)
        latitude, longitude = (
            sum(float(part) / unit for part, unit in zip(gps[tag], (1, 60, 3600), strict=True))
            for tag in (2, 4)
        )
        latitude *= -1 if str(gps[1]).upper().startswith("S") else 1
        longitude *= -1 if str(gps[3]).upper().startswith("W") else 1
    except Exception:  # absent or broken
        return None
    sensible = abs(latitude) <= 90 and abs(longitude) <= 180 and (latitude, longitude) != (0.0, 0.0)
    return (latitude, longitude) if sensible else None


def save_jpeg(picture: Image.Image, original: Image.Image, target: Path) -> None:
    """Write an upright picture with the entries of another one's EXIF block that can be read and written."""
    try:
        exif = _sound_entries(original.getexif())
    except Exception:  # a broken EXIF block costs the focal length, not the photo
        exif = b""
    try:
        picture.save(target, "JPEG", quality=JPEG_QUALITY, subsampling=0, exif=exif)
    except ValueError:  # more than a JPEG can hold
        picture.save(target, "JPEG", quality=JPEG_QUALITY, subsampling=0)


def _sound_entries(exif: Image.Exif) -> bytes:
    """An EXIF block without the orientation and without entries that Pillow cannot write again."""
    sound = Image.Exif()
    for block in (None, EXIF_IFD, GPS_IFD):
        source = exif if block is None else exif.get_ifd(block)
        target = sound if block is None else sound.get_ifd(block)
        for tag, value in list(source.items()):
            if block is None and tag in (EXIF_ORIENTATION, EXIF_IFD, GPS_IFD):
                continue
            try:
                alone = Image.Exif()
                alone[tag] = value
                alone.tobytes()
            except Exception:  # struct.error, TypeError and more, by the entry's type
                continue
            target[tag] = value
    sound[EXIF_ORIENTATION] = 1
    return sound.tobytes()


def _orientation(image: Image.Image) -> int:
    try:
        return int(image.getexif().get(EXIF_ORIENTATION, 1))
    except Exception:
        return 0  # unknown: the copy is written without it
