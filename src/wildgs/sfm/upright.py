"""Copies of a folder of photos that every later step can read: upright, 8-bit, with plain names."""

from __future__ import annotations

import shutil
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from PIL import Image

from wildgs.errors import UserError, WildGSWarning
from wildgs.scene.config import MAX_IMAGE_PIXELS
from wildgs.scene.images import (
    EXIF_ORIENTATION,
    UnreadableImageError,
    open_image,
    read_photo,
)

SUFFIXES = {".jpg", ".jpeg", ".jpe", ".png", ".tif", ".tiff", ".webp", ".bmp", ".heic", ".heif", ".avif"}
JPEG_QUALITY = 97
EXIF_IFD, GPS_IFD = 0x8769, 0x8825
COPIERS = 4
"""Threads that decode and copy; Pillow works without Python's lock."""


@dataclass(frozen=True)
class WorkingCopy:
    """A photo as structure from motion reads it.

    Attributes:
        name: Path of the original within the folder of photos.
        work_name: File name of the copy: letters and digits only, because COLMAP's pair lists end a name at a
            space.
        scene_name: Path that the photo gets in the scene: the original's, as .jpg; unique by its stem.
        masked: Whether the photo's transparent pixels were written as a mask beside the copy.
        position: Latitude and longitude by GPS in degrees, None where the photo carries none.
    """

    name: str
    work_name: str
    scene_name: str
    masked: bool
    position: tuple[float, float] | None = None


def list_photos(folder: Path) -> list[str]:
    """Photos in a folder and its sub-folders, as sorted paths relative to it; hidden files are passed over.

    Raises:
        UserError: There is no such folder, or no photo in it.
    """
    if not folder.is_dir():
        raise UserError(f"{folder}: no such folder; give the folder that holds the photos")
    names = sorted(
        path.relative_to(folder).as_posix()
        for path in folder.rglob("*")
        if path.suffix.lower() in SUFFIXES and path.is_file()
    )
    names = [name for name in names if not any(part.startswith(".") for part in PurePosixPath(name).parts)]
    if not names:
        raise UserError(f"{folder}: no photos (.jpg, .png, .tif, .webp, ...) in this folder; give another")
    return names


def scene_names(names: Sequence[str]) -> list[str]:
    """For each photo a name in the scene: as JPEG, no two with one stem (masks and depth go by stems)."""
    taken: set[str] = set()
    result = []
    for name in names:
        path = PurePosixPath(name)
        stem = path.stem
        if str(path.with_name(stem)).casefold() in taken:
            stem = f"{path.stem}_{path.suffix[1:].lower()}"
        number = 2
        while str(path.with_name(stem)).casefold() in taken:
            stem, number = f"{path.stem}_{path.suffix[1:].lower()}_{number}", number + 1
        taken.add(str(path.with_name(stem)).casefold())
        jpeg = path.suffix.lower() in (".jpg", ".jpeg") and stem == path.stem
        result.append(name if jpeg else str(path.with_name(f"{stem}.jpg")))
    return result


def copy_upright(
    folder: Path,
    images_dir: Path,
    masks_dir: Path,
    *,
    max_pixels: int = MAX_IMAGE_PIXELS,
    progress: Callable[[int, int], None] | None = None,
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
    with ThreadPoolExecutor(COPIERS) as pool:
        for count, (name, result) in enumerate(zip(names, pool.map(copy, plans), strict=True), start=1):
            if isinstance(result, str):
                broken[name] = result
                warnings.warn(
                    f"{folder / name}: {result}; the photo is left out", WildGSWarning, stacklevel=2
                )
            else:
                copies.append(result)
            if progress is not None:
                progress(count, len(names))
    return copies, broken


def _copy_one(
    source: Path, target: Path, masks_dir: Path, max_pixels: int
) -> tuple[bool, tuple[float, float] | None]:
    """Copy one photo; whether a mask was written, and where the photo was taken."""
    photo = read_photo(source, max_pixels=max_pixels)
    with open_image(source, max_pixels) as image:
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
    """Write an upright picture with the entries of another one's EXIF block that can be read."""
    try:
        exif = original.getexif()
        for block in (EXIF_IFD, GPS_IFD):
            exif.get_ifd(block)  # read, or it would not be written again
        exif[EXIF_ORIENTATION] = 1
        picture.save(target, "JPEG", quality=JPEG_QUALITY, subsampling=0, exif=exif.tobytes())
    except Exception:  # a broken EXIF block costs the focal length, not the photo
        picture.save(target, "JPEG", quality=JPEG_QUALITY, subsampling=0)


def _orientation(image: Image.Image) -> int:
    try:
        return int(image.getexif().get(EXIF_ORIENTATION, 1))
    except Exception:
        return 0  # unknown: written anew without it
