"""Data of stereo: brightness and planes of all photos at one resolution, in flat arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32, Int, UInt64
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d

from wildgs.geometry.camera import Camera
from wildgs.priors.resampling import warp
from wildgs.priors.stereo.cost_kernels import WORST, pack_blocks
from wildgs.scene import View
from wildgs.scene.images import LUMA


@dataclass(frozen=True)
class Planes:
    """Planes of all photos and their costs, in the layout of the pixels."""

    planes: Float32[np.ndarray, "P 3"]
    costs: Float32[np.ndarray, " P"]
    layout: Int[np.ndarray, "V 3"]

    def of(self, photo: int) -> tuple[Float32[np.ndarray, "H W 3"], Float32[np.ndarray, "H W"]]:
        """Writable views of the planes and costs of one photo."""
        start, width, height = self.layout[photo]
        own = slice(start, start + width * height)
        return self.planes[own].reshape(height, width, 3), self.costs[own].reshape(height, width)


@dataclass(frozen=True)
class Level:
    """All photos at one resolution: brightness in one flat array, and the position of each photo in it."""

    cameras: list[Camera]
    pixels: Float32[np.ndarray, " P"]
    blocks: UInt64[np.ndarray, " P"]
    layout: Int[np.ndarray, "V 3"]

    @classmethod
    def of(cls, cameras: Sequence[Camera], pictures: Sequence[Float32[np.ndarray, "_ _"]]) -> Level:
        """Packs single-channel photos in [0, 1] with their cameras."""
        sizes = np.array([picture.size for picture in pictures])
        starts = np.concatenate([[0], sizes.cumsum()[:-1]])
        layout = [(start, camera.width, camera.height) for start, camera in zip(starts, cameras, strict=True)]
        pixels = np.concatenate([picture.reshape(-1) for picture in pictures])
        blocks = np.concatenate([pack_blocks(picture) for picture in pictures])
        return cls(list(cameras), pixels, blocks, np.array(layout))

    @classmethod
    def of_views(cls, views: Sequence[View], displacements: Float[Tensor, "V 2 G G"] | None = None) -> Level:
        """Packs the photos of views at their resolution, displaced to where their cameras say (see `warp`)."""
        weights, pictures = torch.tensor(LUMA), []
        for row, view in enumerate(views):
            photo = view.read_photo().float() / 255
            if displacements is not None:
                photo = warp(photo, displacements[row])
            pictures.append((photo @ weights).numpy())
        return cls.of([view.camera for view in views], pictures)

    def halved(self) -> Level:
        """The same photos at half the resolution."""
        cameras, pictures = [], []
        for camera, (start, width, height) in zip(self.cameras, self.layout, strict=True):
            size = (max(1, camera.height // 2), max(1, camera.width // 2))
            picture = torch.from_numpy(self.pixels[start : start + width * height].reshape(height, width))
            pictures.append(adaptive_avg_pool2d(picture[None], size)[0].numpy())
            cameras.append(camera.resized(size[1], size[0]))
        return Level.of(cameras, pictures)

    def no_planes(self) -> Planes:
        """Uninitialised planes of all photos, at the worst cost."""
        count = len(self.pixels)
        return Planes(np.zeros((count, 3), np.float32), np.full(count, WORST, np.float32), self.layout)

    def motions(self, photo: int, others: Sequence[int]) -> Float32[np.ndarray, "S 12"]:
        """Motions from a photo to others (see `cost_kernels`)."""
        return np.stack([_motion(self.cameras[photo], self.cameras[other]) for other in others])

    def returns(self, photo: int, others: Sequence[int]) -> Float32[np.ndarray, "S 12"]:
        """Motions from others to a photo."""
        return np.stack([_motion(self.cameras[other], self.cameras[photo]) for other in others])


def _motion(first: Camera, second: Camera) -> Float32[np.ndarray, "12"]:
    """M = K' R K^-1 (row-major) and v = K' t of the motion from the first camera to the second."""
    relative = second.viewmat.double() @ torch.linalg.inv(first.viewmat.double())
    M = second.K.double() @ relative[:3, :3] @ torch.linalg.inv(first.K.double())
    v = second.K.double() @ relative[:3, 3]
    return torch.cat([M.reshape(-1), v]).float().numpy()


def enlarged(planes: Float32[np.ndarray, "h w 3"], width: int, height: int) -> Float32[np.ndarray, "H W 3"]:
    """Upsamples planes to a higher resolution."""
    down, across = planes.shape[0] / height, planes.shape[1] / width
    y, x = (np.arange(height) + 0.5) * down, (np.arange(width) + 0.5) * across
    j, i = np.minimum(y.astype(int), planes.shape[0] - 1), np.minimum(x.astype(int), planes.shape[1] - 1)
    larger = planes[j[:, None], i[None]]
    larger[..., 0] += larger[..., 1] * (x - i - 0.5)[None] + larger[..., 2] * (y - j - 0.5)[:, None]
    larger[..., 1] *= across
    larger[..., 2] *= down
    return larger.astype(np.float32)
