"""The pictures that belong to one photo: itself, the user's mask, the depth prior, the truth to score by."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
import torch
from jaxtyping import Float, UInt8, UInt16
from torch import Tensor

from wildgs.errors import UserError, WildGSWarning
from wildgs.scene.config import MAX_IMAGE_PIXELS
from wildgs.scene.images import (
    ShapeMismatchError,
    UnreadableImageError,
    read_disparity,
    read_mask,
    read_photo,
)
from wildgs.scene.undistort import PixelGrid, inside, sample_colors, sample_disparity, sample_mask


def depth_file(root: Path, name: str) -> Path:
    """Where the scene keeps the disparity of a photo: `depth/<stem>.png`, sub-folders kept."""
    return root / "depth" / PurePosixPath(name).with_suffix(".png")


@dataclass(frozen=True)
class PhotoFiles:
    """Where one photo's files lie, and how their pixels become the view's.

    Attributes:
        root: The scene's folder.
        images_dir: The folder of its photos.
        name: The photo's path within it.
        grid: From the stored photo's pixels to the view's.
        max_pixels: Larger pictures are refused.
    """

    root: Path
    images_dir: Path
    name: str
    grid: PixelGrid
    max_pixels: int = MAX_IMAGE_PIXELS

    @property
    def photo(self) -> Path:
        """The photo."""
        return self.images_dir / self.name

    def find_mask(self) -> Path | None:
        """The user's mask, `masks/<name>.png` (COLMAP's way) or `masks/<stem>.png`."""
        return self._first("masks", f"{self.name}.png", str(PurePosixPath(self.name).with_suffix(".png")))

    def find_depth(self) -> Path | None:
        """The depth prior's disparity."""
        path = depth_file(self.root, self.name)
        return path if path.is_file() else None

    def find_truth(self, kind: str) -> Path | None:
        """`truth/<kind>/<stem>.png`, which only evaluation may read."""
        return self._first(f"truth/{kind}", str(PurePosixPath(self.name).with_suffix(".png")))

    def _first(self, folder: str, *names: str) -> Path | None:
        return next((path for name in names if (path := self.root / folder / name).is_file()), None)

    def read_clean(self) -> UInt8[Tensor, "H W 3"] | None:
        """The photo without its transients, at the view's size; None where there is none.

        Raises:
            UserError: The file is there and cannot be used.
        """
        path = self.find_truth("clean")
        if path is None:
            return None
        try:
            photo = read_photo(path, camera_size=self.grid.camera_size, size=self.grid.resized)
        except UnreadableImageError as error:
            raise UserError(f"{path}: {error}; mend the file or remove it") from error
        source = self.grid.source()
        return torch.from_numpy(photo.pixels if source is None else sample_colors(photo.pixels, source))

    def read_truth_mask(self) -> UInt8[Tensor, "H W"] | None:
        """Where the photo shows the static scene (255) or a transient (0); None where there is no such file.

        Raises:
            UserError: The file is there and cannot be used.
        """
        path = self.find_truth("masks")
        return None if path is None else torch.from_numpy(self._read_mask(path))

    def _read_mask(self, path: Path) -> UInt8[np.ndarray, "H W"]:
        try:
            mask = read_mask(path, self.grid.resized, self.max_pixels)
        except UnreadableImageError as error:
            raise UserError(f"{path}: {error}; mend the mask or remove it") from error
        source = self.grid.source()
        return mask if source is None else sample_mask(mask, source)

    def load(self, *, use_mask: bool, use_depth: bool) -> Pictures:
        """Decode what training reads.

        Raises:
            UnreadableImageError: The photo itself cannot be decoded.
            UserError: The photo has another shape than its camera, or its mask cannot be used.
        """
        try:
            photo = read_photo(
                self.photo,
                camera_size=self.grid.camera_size,
                size=self.grid.resized,
                max_pixels=self.max_pixels,
            )
        except ShapeMismatchError as error:
            raise UserError(
                f"{self.photo}: {error}; the photos must be those the model was made from"
            ) from error
        source = self.grid.source()
        pixels, masks = photo.pixels, []
        if photo.opaque is not None:
            masks.append(photo.opaque if source is None else sample_mask(photo.opaque, source))
        if source is not None:
            pixels = sample_colors(pixels, source)
            masks.append(np.where(inside(source, self.grid.resized), 255, 0).astype(np.uint8))
        mask_path = self.find_mask() if use_mask else None
        if mask_path is not None:
            masks.append(self._read_mask(mask_path))
        mask = np.minimum.reduce(masks) if masks else None
        return Pictures(
            photo=torch.from_numpy(pixels),
            mask=None if mask is None or mask.all() else torch.from_numpy(mask),
            disparity=self._load_disparity() if use_depth else None,
        )

    def _load_disparity(self) -> UInt16[np.ndarray, "H W"] | None:
        path = self.find_depth()
        if path is None:
            return None
        try:
            disparity = read_disparity(path, self.grid.resized, self.max_pixels)
        except UnreadableImageError as error:
            warnings.warn(
                f"{path}: {error}; this photo trains without depth (delete the file and run `wildgs depth`)",
                WildGSWarning,
                stacklevel=2,
            )
            return None
        source = self.grid.source()
        return disparity if source is None else sample_disparity(disparity, source)


@dataclass(frozen=True)
class Pictures:
    """A photo's decoded pictures at the view's size, as small as they are kept in memory.

    Attributes:
        photo: Colours, 8 bits. Shared between readers: not to be written to.
        mask: 0 = ignore; None where nothing is ignored.
        disparity: 16 bits, 0 = no estimate; None where there is no depth prior.
    """

    photo: UInt8[Tensor, "H W 3"]
    mask: UInt8[Tensor, "H W"] | None
    disparity: UInt16[np.ndarray, "H W"] | None

    @property
    def num_bytes(self) -> int:
        """Memory that they take."""
        mask = 0 if self.mask is None else self.mask.numel()
        return self.photo.numel() + mask + (0 if self.disparity is None else self.disparity.nbytes)

    def read_photo(self) -> UInt8[Tensor, "H W 3"]:
        """The photo's colours."""
        return self.photo

    def read_mask(self) -> UInt8[Tensor, "H W"] | None:
        """The mask of what the user or the file excludes."""
        return self.mask

    def read_disparity(self) -> Float[Tensor, "H W"] | None:
        """Disparity in [0, 1], large = near, unknown scale and shift; 0 = no estimate."""
        if self.disparity is None:
            return None
        return torch.from_numpy(self.disparity.astype(np.float32) / 65535.0)
