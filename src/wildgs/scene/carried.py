"""The copy of a scene in a run folder, with which the run works without the scene folder.

`scene.safetensors` contains cameras, split, alignment, points and their observations. `lights/` contains reduced
copies of the photos and their masks, from which appearances are computed.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from wildgs.errors import UserError
from wildgs.files import check_regular, is_there, written_aside
from wildgs.progress import Counter, in_threads
from wildgs.scene.capture import carry_capture
from wildgs.scene.config import DECODERS
from wildgs.scene.image_cache import ImageCache
from wildgs.scene.images import Photo, UnreadableImageError, read_mask, read_photo
from wildgs.scene.photo_store import PhotoStore
from wildgs.scene.scene import Scene, View
from wildgs.scene.scene_record import SceneRecord

SCENE_FILE = "scene.safetensors"
LIGHTS_FOLDER = "lights"

MAX_SIDE = 512
"""Longest side of a copied photo in pixels."""

MIN_SIDE = 64
MAX_PIXELS = 160_000_000
"""Total number of pixels of all copied photos; with more than about 800 photos, each is reduced further."""

QUALITY = 95
"""JPEG quality, without chroma subsampling."""


def carry_scene(folder: Path, scene: Scene, progress: Counter | None = None) -> None:
    """Writes a copy of the scene to the run folder.

    `scene.safetensors` is written last, so that it marks a complete copy.

    Args:
        folder: The run folder.
        scene: The scene with its photos.
        progress: Called with (photos written, total number of photos).

    Raises:
        UserError: The folder cannot be written to.
    """
    lights = folder / LIGHTS_FOLDER
    side = carried_side([(view.camera.width, view.camera.height) for view in scene.views])

    def write(numbered: tuple[int, View]) -> list[Path]:
        number, view = numbered
        try:
            photo = view.photos.get(view.name)
        except UserError:  # not readable any more; training continues without it, too
            return []
        return _write_photo(lights, number, photo, side, view.photos.file(view.name))

    written = in_threads(write, list(enumerate(scene.views)), DECODERS, progress)
    carried = {file.name: _digest(file) for files in written for file in files}
    replace(SceneRecord.of(scene), carried=carried).write(folder / SCENE_FILE)


def carried_side(sizes: Sequence[tuple[int, int]]) -> int:
    """The longest side, in pixels, of copies of photos with these widths and heights."""
    pixels_per_side = sum(min(size) / max(size) for size in sizes)
    within_total = math.isqrt(int(MAX_PIXELS / max(pixels_per_side, 1e-9)))
    return max(MIN_SIDE, min(MAX_SIDE, within_total))


def _write_photo(lights: Path, number: int, photo: Photo, side: int, original: Path | None) -> list[Path]:
    height, width = photo.pixels.shape[:2]
    shrink = min(1.0, side / max(width, height))
    size = (max(1, round(width * shrink)), max(1, round(height * shrink)))
    image = Image.fromarray(photo.pixels)
    files = [_photo_file(lights, number)]
    with written_aside(files[0]) as aside:
        small = image if size == image.size else image.resize(size, Image.Resampling.LANCZOS)
        small.save(aside, "JPEG", quality=QUALITY, subsampling=0)
        if original is not None:
            carry_capture(original, aside)
    if photo.mask is not None:
        mask = np.array(Image.fromarray(photo.mask).resize(size, Image.Resampling.BOX)) > 127
        files.append(_mask_file(lights, number))
        with written_aside(files[1]) as aside:
            Image.fromarray(mask).save(aside, "PNG")
    return files


def _digest(file: Path) -> str:
    check_regular(file)
    with file.open("rb") as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()[:16]


def _photo_file(lights: Path, number: int) -> Path:
    """The file of a copied photo, numbered like the views, since photos' names may be invalid on other systems."""
    return lights / f"{number:05d}.jpg"


def _mask_file(lights: Path, number: int) -> Path:
    return lights / f"{number:05d}.mask.png"


def read_carried_scene(folder: Path) -> Scene | None:
    """The copy of the scene in a run folder, with photos decoded on demand; None for runs of earlier versions.

    Raises:
        UserError: The file cannot be read.
    """
    if not is_there(folder / SCENE_FILE):
        return None
    record = SceneRecord.read(folder / SCENE_FILE)
    return record.scene(folder, CarriedPhotos(folder / LIGHTS_FOLDER, record))


def describe_carried(folder: Path) -> str:
    """Describes the copy of the scene in a run folder in one line, for the console."""
    files = [file for file in (folder / LIGHTS_FOLDER).glob("*") if file.is_file()]
    megabytes = (sum(file.stat().st_size for file in files) + (folder / SCENE_FILE).stat().st_size) / 1e6
    count = sum(file.suffix == ".jpg" for file in files)
    return (
        f"{folder} contains its cameras, points and {count} photos of at most {MAX_SIDE} pixels "
        f"({megabytes:.1f} MB) and works without the scene folder"
    )


class CarriedPhotos(PhotoStore):
    """The photos in a run's folder `lights/`, upsampled to the size of their cameras if necessary."""

    def __init__(self, folder: Path, record: SceneRecord) -> None:
        """Creates the store for the photos of a recorded scene in a folder `lights/`."""
        self._folder = folder
        self._numbers = {name: number for number, name in enumerate(record.names)}
        self._digests = record.carried
        self._sizes = [(int(width), int(height)) for width, height in record.sizes]
        self._cache = ImageCache(0)
        self.detail = carried_side(self._sizes)

    def get(self, name: str) -> Photo:
        """See `PhotoStore.get`."""
        return self._cache.get(name, lambda: self._decode(name))

    def file(self, name: str) -> Path:
        """See `PhotoStore.file`."""
        return _photo_file(self._folder, self._numbers[name])

    def prefetch(self, name: str) -> None:
        """See `PhotoStore.prefetch`."""
        self._cache.prefetch(name, lambda: self._decode(name))

    def _decode(self, name: str) -> Photo:
        number = self._numbers[name]
        path, size = _photo_file(self._folder, number), self._sizes[number]
        try:
            pixels = read_photo(self._checked(path), size=size).pixels
            path = _mask_file(self._folder, number)
            return Photo(pixels, read_mask(self._checked(path), size) if self._carries(path) else None)
        except UnreadableImageError as error:
            raise UserError(
                f"{path}: {error}; this is the run's copy of {name}: copy the complete run folder again"
            ) from error

    def _carries(self, path: Path) -> bool:
        return path.name in self._digests if self._digests else is_there(path)

    def _checked(self, path: Path) -> Path:
        """The path of a file after verifying its digest; raises `UnreadableImageError` if it does not match."""
        expected = self._digests.get(path.name)
        try:
            if expected is not None and _digest(path) != expected:
                raise UnreadableImageError("damaged, or from another run")
        except FileNotFoundError:
            raise UnreadableImageError("no such file") from None
        except OSError as error:
            raise UnreadableImageError(error.strerror or str(error)) from error
        return path
