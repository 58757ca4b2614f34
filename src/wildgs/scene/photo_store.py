"""Photo stores: pixels, mask and depth maps of views, decoded on demand."""

from __future__ import annotations

import warnings
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path, PurePosixPath
from typing import TypeVar

import numpy as np
from jaxtyping import Float32, UInt8, UInt16

from wildgs.errors import UserError, WildGSWarning
from wildgs.files import fingerprint, is_there
from wildgs.scene.config import MAX_IMAGE_PIXELS
from wildgs.scene.image_cache import ImageCache
from wildgs.scene.images import (
    Photo,
    ShapeMismatchError,
    UnreadableImageError,
    read_depth,
    read_disparity,
    read_mask,
    read_photo,
)
from wildgs.scene.undistort import (
    PixelGrid,
    inside,
    sample_colors,
    sample_depth,
    sample_disparity,
    sample_mask,
)

_Values = TypeVar("_Values", bound=np.ndarray)


def with_ending(name: str, ending: str) -> str:
    """A photo's name, including sub-folders, with another extension."""
    return str(PurePosixPath(name).with_suffix(ending))


def depth_files(root: Path, names: Iterable[str]) -> dict[str, Path]:
    """Paths of the disparity maps of a scene's photos.

    `depth/<stem>.png`, including sub-folders; `depth/<name>.png` where there is one, and for photos whose names
    differ only in the extension.

    Args:
        root: The scene folder.
        names: All photos of the model.
    """
    names = list(names)
    shared = _shared_stems(names)
    files = {}
    for name in names:
        short, full = (root / "depth" / file for file in (with_ending(name, ".png"), f"{name}.png"))
        own = with_ending(name, "") in shared or (_has_depth(full) and not _has_depth(short))
        files[name] = full if own else short
    return files


def _has_depth(disparity: Path) -> bool:
    return is_there(disparity) or is_there(metric_file(disparity))


def metric_file(disparity: Path) -> Path:
    """Path of a photo's metric depth map (32-bit floats, units of the model) beside that of its disparity."""
    return disparity.with_suffix(".tiff")


def _shared_stems(names: Iterable[str]) -> set[str]:
    """Names without extension that several photos have."""
    counts = Counter(with_ending(name, "") for name in names)
    return {stem for stem, count in counts.items() if count > 1}


class PhotoStore(ABC):
    """A store from which the views of a scene read their photos.

    Attributes:
        detail: Longest side, in pixels, of the stored photos, which may be upsampled; None without limit.
    """

    detail: int | None = None

    @abstractmethod
    def get(self, name: str) -> Photo:
        """A photo at the size of its view's camera.

        Raises:
            UserError: The photo cannot be read.
        """

    def fingerprint(self, name: str) -> dict[str, str]:
        """Digests of a photo's files by their role; empty without files."""
        return {}

    def file(self, name: str) -> Path | None:
        """The file of a photo; None for stores without files."""
        return None

    def prefetch(self, name: str) -> None:  # noqa: B027 - does nothing by default
        """Announces that a photo is needed soon, so that it can be decoded in the background."""

    def read_clean(self, name: str) -> UInt8[np.ndarray, "H W 3"] | None:
        """The photo without transients (ground truth, for evaluation only); None if there is none.

        Raises:
            UserError: The file exists but cannot be used.
        """
        return None

    def read_truth_mask(self, name: str) -> UInt8[np.ndarray, "H W"] | None:
        """Ground truth mask: 255 = static, 0 = transient; None if there is none.

        Raises:
            UserError: The file exists but cannot be used.
        """
        return None


class ScenePhotos(PhotoStore):
    """The photos of a scene folder with masks and depth maps, in a cache of limited memory.

    Attributes:
        blank: Photos read by `load` that are masked completely.
    """

    def __init__(
        self,
        root: Path,
        images_dir: Path,
        names: Sequence[str],
        cache: ImageCache,
        *,
        use_masks: bool = True,
        use_depth: bool = True,
        use_metric_depth: bool = True,
        max_pixels: int = MAX_IMAGE_PIXELS,
        depth_scale: float = 1.0,
    ) -> None:
        """Creates an empty store, to which `add` adds photos.

        Args:
            root: The scene folder.
            images_dir: The folder of the photos.
            names: All photos of the model.
            cache: Cache of decoded photos.
            use_masks: Whether masks/ is read.
            use_depth: Whether depth/ is read.
            use_metric_depth: Whether this includes metric depth.
            max_pixels: Larger images are not read.
            depth_scale: Factor from units of the model to units of the scene.
        """
        self.depth_scale = depth_scale
        self.root = root
        self.images_dir = images_dir
        self.cache = cache
        self.use_masks = use_masks
        self.use_depth = use_depth
        self.use_metric_depth = use_depth and use_metric_depth
        self.max_pixels = max_pixels
        self._grids: dict[str, PixelGrid] = {}
        self._depth = depth_files(root, names)
        self._shared = _shared_stems(names)
        self._without_depth: set[Path] = set()
        self.blank: set[str] = set()

    def add(self, name: str, grid: PixelGrid) -> None:
        """Adds a photo by its path within the folder of photos."""
        self._grids[name] = grid

    def load(self, name: str, *, keep: bool) -> None:
        """Decodes a photo for the first time; with `keep`, as for training photos, it may stay in memory.

        Raises:
            UnreadableImageError: The photo cannot be decoded.
            UserError: The photo has another aspect ratio than its camera, or its mask cannot be used.
        """
        photo = self._decode(name)
        if photo.mask is not None and not photo.mask.any():
            self.blank.add(name)
        self.cache.put(name, photo, keep=keep)

    def get(self, name: str) -> Photo:
        """See `PhotoStore.get`."""
        try:
            return self.cache.get(name, lambda: self._decode(name))
        except UnreadableImageError as error:
            raise UserError(f"{self.images_dir / name}: {error}; restore or replace the photo") from error

    def fingerprint(self, name: str) -> dict[str, str]:
        """See `PhotoStore.fingerprint`; for photo, mask and depth maps, as far as they are used."""
        files = {
            "content": self.images_dir / name,
            "mask": self.find_mask(name) if self.use_masks else None,
            "depth prior": self._depth[name] if self.use_depth else None,
            "metric depth": metric_file(self._depth[name]) if self.use_metric_depth else None,
        }
        return {what: digest for what, file in files.items() if file and (digest := fingerprint(file))}

    def file(self, name: str) -> Path:
        """See `PhotoStore.file`."""
        return self.images_dir / name

    def prefetch(self, name: str) -> None:
        """See `PhotoStore.prefetch`."""
        self.cache.prefetch(name, lambda: self._decode(name))

    def read_clean(self, name: str) -> UInt8[np.ndarray, "H W 3"] | None:
        """See `PhotoStore.read_clean`: `truth/clean/<stem>.png`."""
        path = self._find("truth/clean", with_ending(name, ".png"))
        if path is None:
            return None
        grid = self._grids[name]
        try:
            photo = read_photo(path, camera_size=grid.camera_size, size=grid.resized)
        except UnreadableImageError as error:
            raise UserError(f"{path}: {error}; repair the file or remove it") from error
        source = grid.source()
        return photo.pixels if source is None else sample_colors(photo.pixels, source)

    def read_truth_mask(self, name: str) -> UInt8[np.ndarray, "H W"] | None:
        """See `PhotoStore.read_truth_mask`: `truth/masks/<stem>.png`."""
        path = self._find("truth/masks", with_ending(name, ".png"))
        return None if path is None else self._read_mask(path, self._grids[name])

    def find_mask(self, name: str) -> Path | None:
        """The user's mask: `masks/<name>.png` (COLMAP), `masks/<name>`, or an unambiguous `masks/<stem>.png`."""
        stem = with_ending(name, "")
        candidates = [f"{name}.png", name, *([] if stem in self._shared else [f"{stem}.png"])]
        return self._find("masks", *candidates)

    def _find(self, folder: str, *names: str) -> Path | None:
        """The first existing path, even if it is not a regular file, which is reported when it is read."""
        return next((path for name in names if is_there(path := self.root / folder / name)), None)

    def unused(self, folder: str) -> list[str]:
        """Files in `masks/` or `depth/` that belong to no photo, by relative names."""
        files = [path for path in (self.root / folder).rglob("*") if not path.is_dir()]
        if not files:
            return []
        names = {path.relative_to(self.images_dir).as_posix() for path in self.images_dir.rglob("*")}
        known = set()
        if folder == "depth":
            others = depth_files(self.root, names - set(self._depth))
            for path in (*self._depth.values(), *others.values()):
                known |= {
                    each.relative_to(self.root / "depth").as_posix() for each in (path, metric_file(path))
                }
        else:
            for name in names | set(self._depth):
                known |= {name, f"{name}.png"}
                known |= set() if with_ending(name, "") in self._shared else {with_ending(name, ".png")}
        return sorted(
            name
            for path in files
            if (name := path.relative_to(self.root / folder).as_posix()) not in known
            and not any(part.startswith(".") for part in PurePosixPath(name).parts)
        )

    def _read_mask(self, path: Path, grid: PixelGrid) -> UInt8[np.ndarray, "H W"]:
        try:
            mask = read_mask(path, grid.resized, self.max_pixels)
        except UnreadableImageError as error:
            raise UserError(f"{path}: {error}; repair the mask or remove it") from error
        source = grid.source()
        return mask if source is None else sample_mask(mask, source)

    def _decode(self, name: str) -> Photo:
        """Decodes a photo with its mask and depth maps.

        Raises:
            UnreadableImageError: The photo cannot be decoded.
            UserError: The photo has another aspect ratio than its camera, or its mask cannot be used.
        """
        path, grid = self.images_dir / name, self._grids[name]
        try:
            photo = read_photo(
                path, camera_size=grid.camera_size, size=grid.resized, max_pixels=self.max_pixels
            )
        except ShapeMismatchError as error:
            raise UserError(f"{path}: {error}; use the photos from which the model was made") from error
        source = grid.source()
        pixels, masks = photo.pixels, []
        if photo.mask is not None:
            masks.append(photo.mask if source is None else sample_mask(photo.mask, source))
        if source is not None:
            pixels = sample_colors(pixels, source)
            masks.append(np.where(inside(source, grid.resized), 255, 0).astype(np.uint8))
        mask_path = self.find_mask(name) if self.use_masks else None
        if mask_path is not None:
            masks.append(self._read_mask(mask_path, grid))
        mask = np.minimum.reduce(masks) if masks else None
        mask = None if mask is None or mask.all() else mask
        return Photo(pixels, mask, self._read_disparity(name, grid), self._read_depth(name, grid))

    def _read_disparity(self, name: str, grid: PixelGrid) -> UInt16[np.ndarray, "H W"] | None:
        disparity = self._read_prior(self._depth[name], grid, read_disparity)
        source = None if disparity is None else grid.source()
        return disparity if source is None or disparity is None else sample_disparity(disparity, source)

    def _read_depth(self, name: str, grid: PixelGrid) -> Float32[np.ndarray, "H W"] | None:
        if not self.use_metric_depth:
            return None
        depth = self._read_prior(metric_file(self._depth[name]), grid, read_depth)
        if depth is None:
            return None
        source = grid.source()
        depth = depth if source is None else sample_depth(depth, source)
        with np.errstate(over="ignore"):
            depth = depth * np.float32(self.depth_scale)
        return np.where(np.isfinite(depth), depth, np.float32(0))

    def _read_prior(
        self, path: Path, grid: PixelGrid, read: Callable[[Path, tuple[int, int], int], _Values]
    ) -> _Values | None:
        """Reads a file of depth/; searches for, and warns of, a missing or unreadable file only once."""
        if not self.use_depth or path in self._without_depth or not is_there(path):
            self._without_depth.add(path)
            return None
        try:
            return read(path, grid.resized, self.max_pixels)
        except UnreadableImageError as error:
            self._without_depth.add(path)
            warnings.warn(
                f"{path}: {error}; this photo trains without depth (delete the file and run `wildgs depth`)",
                WildGSWarning,
                stacklevel=2,
            )
            return None
