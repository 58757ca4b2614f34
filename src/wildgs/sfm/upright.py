"""Working copies of photos for structure from motion: upright, 8-bit, with simple names."""

from __future__ import annotations

import hashlib
import os
import shutil
import unicodedata
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath, PureWindowsPath

from PIL import Image

from wildgs.errors import UserError, WildGSWarning
from wildgs.files import describe_names, is_file, is_unprintable, printable
from wildgs.progress import Counter, in_threads
from wildgs.scene.capture import read_place
from wildgs.scene.config import DECODERS, MAX_IMAGE_PIXELS
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
"""Extensions of photos; files without extension are recognised by their content."""
MAX_NAME_BYTES = 240
"""Longest name of a photo in the scene; masks add an extension, and file systems allow 255 bytes."""
JPEG_QUALITY = 97
EXIF_IFD, GPS_IFD = 0x8769, 0x8825


@dataclass(frozen=True)
class WorkingCopy:
    """A working copy of a photo.

    Attributes:
        name: Path of the original within the folder of photos.
        work_name: File name of the copy, digits only, because names in COLMAP's pair lists end at a space.
        scene_name: Path of the photo in the scene: the original's as .jpg, without characters that COLMAP models or
            other systems do not support; with a unique stem.
        masked: Whether a mask of the photo's transparent pixels was written.
        position: GPS latitude and longitude in degrees; None if unknown.
    """

    name: str
    work_name: str
    scene_name: str
    masked: bool
    position: tuple[float, float] | None = None


def list_photos(folder: Path) -> list[str]:
    """Photos in a folder and its sub-folders, as sorted relative paths; hidden files are skipped.

    Links to folders are followed, once each. Warns of files that are not photos.

    Raises:
        UserError: The folder does not exist or contains no photos.
    """
    if not folder.is_dir():
        raise UserError(f"{folder}: no such folder; give the folder of the photos")
    names, others, broken = [], [], []
    for path in _files_below(folder):
        name = path.relative_to(folder).as_posix()
        if path.is_symlink() and not path.exists():
            broken.append(name)
        else:
            (names if is_file(path) and _is_photo(path) else others).append(name)
    if broken:
        warnings.warn(
            f"{folder}: {len(broken)} links point to files that do not exist; connect their drive, or remove them:"
            f" {describe_names([printable(name) for name in broken])}",
            WildGSWarning,
            stacklevel=2,
        )
    if not names:
        raise UserError(f"{folder}: no photos (.jpg, .png, .tif, .webp, ...) in this folder; give another")
    if others:
        warnings.warn(
            f"{folder}: {len(others)} files are not photos by their extension and are not used:"
            f" {describe_names([printable(name) for name in others])}",
            WildGSWarning,
            stacklevel=2,
        )
    return names


def _files_below(folder: Path) -> list[Path]:
    """Files in a folder and its sub-folders, sorted, without hidden ones."""
    files, visited = [], set()
    for parent, folders, names in os.walk(folder, followlinks=True):
        visited.add(os.path.realpath(parent))
        folders[:] = [
            name
            for name in sorted(folders)
            if not name.startswith(".") and os.path.realpath(Path(parent, name)) not in visited
        ]
        files += [Path(parent, name) for name in names if not name.startswith(".")]
    return sorted(files)


def _is_photo(path: Path) -> bool:
    if path.suffix:
        return path.suffix.lower() in SUFFIXES
    try:
        open_image(path).close()
    except UnreadableImageError:
        return False
    return True


def scene_names(names: Sequence[str]) -> list[str]:
    r"""Names of photos in the scene: with .jpg and unique stems, which masks and depth maps share.

    Names that COLMAP models do not support (bytes that are not UTF-8, control characters), that have another
    meaning on other systems (`\`, drives) or that are too long are replaced by similar ones.
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
    """A name normalised for file systems that ignore case and Unicode composition."""
    return unicodedata.normalize("NFC", unicodedata.normalize("NFC", str(path)).casefold())


def _safe_part(part: str) -> str:
    """Replaces unsupported characters of a file or folder name and limits its length."""
    safe = "".join("_" if is_unprintable(c) or c == "\\" else c for c in part)
    if PureWindowsPath(safe).drive:
        safe = safe.replace(":", "_", 1)
    if len(safe.encode()) <= MAX_NAME_BYTES - 16:  # leaves room for suffixes that make names unique
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
    """Writes upright 8-bit JPEG copies of all photos with their EXIF data (focal length, GPS).

    Args:
        folder: Folder of photos.
        images_dir: Folder for the copies; created if missing.
        masks_dir: Folder for masks of transparent pixels, named as in COLMAP (`<copy>.png`, 0 = ignore).
        max_pixels: Larger photos are skipped.
        progress: Called with (photos copied, total number of photos).

    Returns:
        The copies, and the reasons for photos that could not be read, of which it also warns.

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
    for name, result in zip(names, in_threads(copy, plans, DECODERS, progress), strict=True):
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
    """Copies one photo; returns whether a mask was written, and the GPS position."""
    with open_image(source, max_pixels) as image, decoding(image):
        photo = read_photo(source, max_pixels=max_pixels)
        position = _gps_position(image)
        if image.format == "JPEG" and image.mode == "RGB" and _orientation(image) == 1:
            shutil.copyfile(source, target)  # lossless
            return False, position
        save_jpeg(Image.fromarray(photo.pixels), image, target)
        if photo.mask is None or photo.mask.all():
            return False, position
        masks_dir.mkdir(parents=True, exist_ok=True)
        Image.fromarray(photo.mask).save(masks_dir / f"{target.name}.png")
    return True, position


def _gps_position(image: Image.Image) -> tuple[float, float] | None:
    """GPS latitude and longitude in degrees; COLMAP only reads positions with an altitude."""
    try:
        return read_place(image.getexif().get_ifd(GPS_IFD))
    except Exception:  # EXIF data may be malformed in any way
        return None


def save_jpeg(picture: Image.Image, original: Image.Image, target: Path) -> None:
    """Writes an upright image with the valid EXIF entries of another one."""
    try:
        exif = _valid_entries(original.getexif())
    except Exception:  # invalid EXIF data is ignored
        exif = b""
    try:
        picture.save(target, "JPEG", quality=JPEG_QUALITY, subsampling=0, exif=exif)
    except ValueError:  # more EXIF data than a JPEG can hold
        picture.save(target, "JPEG", quality=JPEG_QUALITY, subsampling=0)


def _valid_entries(exif: Image.Exif) -> bytes:
    """EXIF data without the orientation and without entries that Pillow cannot write."""
    valid = Image.Exif()
    for block in (None, EXIF_IFD, GPS_IFD):
        source = exif if block is None else exif.get_ifd(block)
        target = valid if block is None else valid.get_ifd(block)
        for tag, value in list(source.items()):
            if block is None and tag in (EXIF_ORIENTATION, EXIF_IFD, GPS_IFD):
                continue
            try:
                alone = Image.Exif()
                alone[tag] = value
                alone.tobytes()
            except Exception:  # struct.error, TypeError and others, depending on the entry's type
                continue
            target[tag] = value
    valid[EXIF_ORIENTATION] = 1
    return valid.tobytes()


def _orientation(image: Image.Image) -> int:
    try:
        return int(image.getexif().get(EXIF_ORIENTATION, 1))
    except Exception:
        return 0  # unknown: the copy is written without it
