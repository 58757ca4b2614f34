"""Residuals of structure from motion: where photos show points, less where their cameras project them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from wildgs.scene.colmap import ColmapImage
from wildgs.scene.undistort import PixelGrid

LARGEST = 1 / 160
"""Largest residual relative to the photo's longer side; larger ones are wrong matches."""


@dataclass(frozen=True)
class Residuals:
    """Residuals of one photo, in units of the view's longer side.

    Attributes:
        places: Where the camera projects the points (x, y); the upper left corner of the view is (0, 0).
        offsets: From there to where the photo shows them (x, y).
    """

    places: Float[Tensor, "K 2"]
    offsets: Float[Tensor, "K 2"]

    @classmethod
    def none(cls) -> Residuals:
        """Those of a photo that shows no points."""
        return cls(torch.zeros(0, 2), torch.zeros(0, 2))


def residuals_of(image: ColmapImage, points: Float[Tensor, "P 3"], grid: PixelGrid) -> Residuals:
    """Residuals of a photo's points inside the view, without those of wrong matches.

    Args:
        image: The photo with its camera, pose and points.
        points: All points, in the model's frame.
        grid: The view's pixel grid; residuals are those after undistortion.
    """
    if not len(image.shown):
        return Residuals.none()
    place = points[torch.from_numpy(image.shown)] @ image.viewmat[:3, :3].T + image.viewmat[:3, 3]
    projected = place[:, :2] / place[:, 2:]
    seen = torch.from_numpy(np.asarray(image.camera.cam_from_img(image.pixels.astype(np.float64))))
    scale = torch.stack([grid.K[0, 0], grid.K[1, 1]])
    side = max(grid.width, grid.height)
    pixels, offsets = projected * scale + grid.K[:2, 2], (seen - projected) * scale / side
    inside = ((pixels >= 0) & (pixels < torch.tensor([grid.width, grid.height]))).all(dim=1)
    usable = (place[:, 2] > 0) & inside & (offsets.norm(dim=1) < LARGEST)
    return Residuals((pixels / side)[usable].float(), offsets[usable].float())
