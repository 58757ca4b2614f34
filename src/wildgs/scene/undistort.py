"""Mapping between the pixels of a stored photo and of its view: resizing and undistortion."""

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
    """The pixel grid of a view and its relation to the stored photo.

    Attributes:
        camera_size: Width and height of COLMAP's camera (of the photo, or with its aspect ratio).
        resized: Width and height to which stored images are resized first.
        K: Intrinsics of the view, pixels.
        width: Width of the view; differs from `resized` only after undistortion.
        height: Height of the view.
        distorted: pycolmap's camera of the resized photo; None without distortion.
        undistorted: pycolmap's pinhole camera of the view; None without distortion.
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
        """The grid of a view for a camera.

        Args:
            camera: pycolmap's camera, any model with a field of view below 180 degrees.
            downscale: Factor by which width and height are divided, with rounding.
            max_side: Longest side of the view, after division; None for no limit.

        Returns:
            The grid, for distorted cameras with pycolmap's undistorted pinhole camera (without blank pixels).
        """
        size = (camera.width, camera.height)
        downscale = max(downscale, max(size) / (max_side or max(size)))
        resized = (max(1, round(size[0] / downscale)), max(1, round(size[1] / downscale)))
        scaled = pycolmap.Camera(camera.todict())
        scaled.rescale(*resized)
        # pycolmap calls a fisheye without coefficients undistorted, too.
        if camera.is_undistorted() and "FISHEYE" not in camera.model_name:
            return cls(size, resized, _intrinsics(scaled), *resized)
        pinhole = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), scaled)
        excess = max(pinhole.width, pinhole.height) / (max_side or np.inf)
        if excess > 1:  # the undistorted view is larger than the photo
            return cls.from_colmap(
                camera, downscale * excess * (1 + 0.5 / max(pinhole.width, pinhole.height))
            )
        return cls(size, resized, _intrinsics(pinhole), pinhole.width, pinhole.height, scaled, pinhole)

    def source(self) -> Float32[np.ndarray, "H W 2"] | None:
        """For every pixel of the view, its position (row, column as array indices) in the resized photo."""
        if self.distorted is None or self.undistorted is None:
            return None
        return _places(self.undistorted, self.distorted, self.width, self.height)

    def target(self) -> Float32[np.ndarray, "h w 2"] | None:
        """For every pixel of the resized photo, its position (row, column as array indices) in the view."""
        if self.distorted is None or self.undistorted is None:
            return None
        return _places(self.distorted, self.undistorted, *self.resized)


def _places(camera: Any, other: Any, width: int, height: int) -> Float32[np.ndarray, "H W 2"]:
    """Positions (row, column) of one camera's pixels in the image of another camera with the same pose."""
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = camera.cam_from_img(np.stack([x.ravel(), y.ravel()], axis=1))
    rays = np.concatenate([rays, np.ones((len(rays), 1))], axis=1)
    pixels = other.img_from_cam(rays).reshape(height, width, 2)
    return np.nan_to_num(pixels[..., ::-1] - 0.5, nan=-1e6).astype(np.float32)


def _intrinsics(camera: Any) -> Float[Tensor, "3 3"]:
    return torch.from_numpy(np.array(camera.calibration_matrix(), dtype=np.float64))


def inside(source: Float32[np.ndarray, "H W 2"], size: tuple[int, int]) -> Bool[np.ndarray, "H W"]:
    """Mask of the pixels of the view that a photo of this size (width, height) covers."""
    row, column = source[..., 0], source[..., 1]
    return (row >= -0.5) & (row <= size[1] - 0.5) & (column >= -0.5) & (column <= size[0] - 0.5)


def sample_colors(
    pixels: UInt8[np.ndarray, "h w 3"], source: Float32[np.ndarray, "H W 2"]
) -> UInt8[np.ndarray, "H W 3"]:
    """Samples colours of the view, bilinear."""
    return np.stack([_sample(pixels[..., c], source, order=1) for c in range(3)], axis=-1).astype(np.uint8)


def sample_mask(
    mask: UInt8[np.ndarray, "h w"], source: Float32[np.ndarray, "H W 2"]
) -> UInt8[np.ndarray, "H W"]:
    """Samples a mask of the view, nearest neighbour."""
    return _sample(mask, source, order=0).astype(np.uint8)


def sample_disparity(
    disparity: UInt16[np.ndarray, "h w"], source: Float32[np.ndarray, "H W 2"]
) -> UInt16[np.ndarray, "H W"]:
    """Samples disparity of the view, bilinear among pixels with an estimate; 0 if most have none."""
    values = _sample(disparity, source, order=1)
    share = _sample((disparity > 0).astype(np.float32), source, order=1)
    mean = np.maximum(values / np.maximum(share, 0.5), 1.0)
    return np.where(share >= 0.5, np.clip(np.round(mean), 0, 65535), 0).astype(np.uint16)


def sample_depth(
    depth: Float32[np.ndarray, "h w"], source: Float32[np.ndarray, "H W 2"]
) -> Float32[np.ndarray, "H W"]:
    """Samples depth of the view, nearest neighbour; 0 outside the image."""
    values = _sample(depth, source, order=0)
    return np.where(inside(source, (depth.shape[1], depth.shape[0])), values, np.float32(0))


def _sample(
    channel: Shaped[np.ndarray, "h w"], source: Float32[np.ndarray, "H W 2"], order: int
) -> Float32[np.ndarray, "H W"]:
    coordinates = np.moveaxis(source, -1, 0)
    sampled = map_coordinates(channel.astype(np.float32), coordinates, order=order, mode="nearest")
    # Rounded here, because the conversion to integers truncates.
    return np.round(sampled) if channel.dtype.kind in "ui" else sampled
