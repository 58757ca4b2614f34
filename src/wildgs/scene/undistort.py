"""From the pixel grid of a stored photo to that of its view: a smaller size, and no lens distortion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pycolmap
import torch
from jaxtyping import Bool, Float, Float32, Shaped, UInt8, UInt16
from scipy.ndimage import map_coordinates
from torch import Tensor


@dataclass(frozen=True)
class PixelGrid:
    """How a photo becomes a view.

    Attributes:
        camera_size: Width and height for which COLMAP's camera was estimated (the photo's own, or its shape).
        resized: Width and height to which stored pictures are resized first.
        K: Intrinsics of the view, pixels.
        width: Width of the view; differs from `resized` only where distortion is taken out.
        height: Height of the view.
        distorted: pycolmap's camera for the resized photo, None where it has no distortion.
        undistorted: pycolmap's pinhole camera for the view, None likewise.
    """

    camera_size: tuple[int, int]
    resized: tuple[int, int]
    K: Float[Tensor, "3 3"]
    width: int
    height: int
    distorted: Any = None
    undistorted: Any = None

    @classmethod
    def from_colmap(cls, camera: Any, downscale: int | float = 1, max_side: int | None = None) -> PixelGrid:
        """The grid of a view that is smaller than its camera.

        Args:
            camera: pycolmap's camera, any model that sees less than a half-sphere.
            downscale: Divides width and height; the result is rounded to whole pixels.
            max_side: Longer side of the view at most, after division; None for no limit.

        Returns:
            Pinhole cameras as they are; others with the pinhole camera that pycolmap finds for them (no blank
            pixels), at the smaller size.
        """
        size = (camera.width, camera.height)
        downscale = max(downscale, max(size) / (max_side or max(size)))
        resized = (max(1, round(size[0] / downscale)), max(1, round(size[1] / downscale)))
        scaled = pycolmap.Camera(camera.todict())
        scaled.rescale(*resized)
        if camera.is_undistorted():
            return cls(size, resized, _intrinsics(scaled), *resized)
        pinhole = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), scaled)
        excess = max(pinhole.width, pinhole.height) / (max_side or np.inf)
        if excess > 1:  # without distortion the view is larger than the photo
            return cls.from_colmap(
                camera, downscale * excess * (1 + 0.5 / max(pinhole.width, pinhole.height))
            )
        return cls(size, resized, _intrinsics(pinhole), pinhole.width, pinhole.height, scaled, pinhole)

    def source(self) -> Float32[np.ndarray, "H W 2"] | None:
        """For every pixel of the view, where (row, column as array indices) it lies in the resized photo."""
        if self.distorted is None or self.undistorted is None:
            return None
        return _places(self.undistorted, self.distorted, self.width, self.height)

    def target(self) -> Float32[np.ndarray, "h w 2"] | None:
        """For every pixel of the resized photo, where (row, column as array indices) it lies in the view."""
        if self.distorted is None or self.undistorted is None:
            return None
        return _places(self.distorted, self.undistorted, *self.resized)


def _places(camera: Any, other: Any, width: int, height: int) -> Float32[np.ndarray, "H W 2"]:
    """Where (row, column) pixels of one camera of a lens lie in a picture of the other."""
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = camera.cam_from_img(np.stack([x.ravel(), y.ravel()], axis=1))
    rays = np.concatenate([rays, np.ones((len(rays), 1))], axis=1)
    pixels = other.img_from_cam(rays).reshape(height, width, 2)
    return np.nan_to_num(pixels[..., ::-1] - 0.5, nan=-1e6).astype(np.float32)


def _intrinsics(camera: Any) -> Float[Tensor, "3 3"]:
    return torch.from_numpy(np.array(camera.calibration_matrix(), dtype=np.float64))


def inside(source: Float32[np.ndarray, "H W 2"], size: tuple[int, int]) -> Bool[np.ndarray, "H W"]:
    """Which pixels of the view the photo (width, height) covers."""
    row, column = source[..., 0], source[..., 1]
    return (row >= -0.5) & (row <= size[1] - 0.5) & (column >= -0.5) & (column <= size[0] - 0.5)


def sample_colors(
    pixels: UInt8[np.ndarray, "h w 3"], source: Float32[np.ndarray, "H W 2"]
) -> UInt8[np.ndarray, "H W 3"]:
    """Colours of the view, bilinear."""
    return np.stack([_sample(pixels[..., c], source, order=1) for c in range(3)], axis=-1).astype(np.uint8)


def sample_mask(
    mask: UInt8[np.ndarray, "h w"], source: Float32[np.ndarray, "H W 2"]
) -> UInt8[np.ndarray, "H W"]:
    """A mask of the view: the nearest pixel's value."""
    return _sample(mask, source, order=0).astype(np.uint8)


def sample_disparity(
    disparity: UInt16[np.ndarray, "h w"], source: Float32[np.ndarray, "H W 2"]
) -> UInt16[np.ndarray, "H W"]:
    """Disparity of the view, bilinear among pixels that have an estimate; 0 where most have none."""
    values = _sample(disparity, source, order=1)
    share = _sample((disparity > 0).astype(np.float32), source, order=1)
    mean = np.maximum(values / np.maximum(share, 0.5), 1.0)
    return np.where(share >= 0.5, np.clip(np.round(mean), 0, 65535), 0).astype(np.uint16)


def sample_depth(
    depth: Float32[np.ndarray, "h w"], source: Float32[np.ndarray, "H W 2"]
) -> Float32[np.ndarray, "H W"]:
    """Depth of the view: the nearest pixel's, 0 outside the picture."""
    values = _sample(depth, source, order=0)
    return np.where(inside(source, (depth.shape[1], depth.shape[0])), values, np.float32(0))


def _sample(
    channel: Shaped[np.ndarray, "h w"], source: Float32[np.ndarray, "H W 2"], order: int
) -> Float32[np.ndarray, "H W"]:
    coordinates = np.moveaxis(source, -1, 0)
    sampled = map_coordinates(channel.astype(np.float32), coordinates, order=order, mode="nearest")
    # Rounded, because 8 and 16-bit values are cut, not rounded, on the way back to integers.
    return np.round(sampled) if channel.dtype.kind in "ui" else sampled
