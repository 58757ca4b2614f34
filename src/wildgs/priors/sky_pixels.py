"""Which pixels of a photo certainly show sky, from the photo and the sparse points alone.

Not in the paper. Sky has no parallax and differs between photos, so that training explains it by haze in front of
single cameras unless something tells it where the scene ends.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage
from torch import Tensor
from torch.nn import functional

from wildgs.geometry.camera import Camera

SIDE = 160
"""Longer side, in pixels, to which photos are reduced."""
SMOOTH = 0.03
"""Largest standard deviation of a channel in a window of 5 x 5 pixels; clouds are smoother, foliage is not."""
LEAST_ELEVATION = 2.0
"""Lowest elevation of the sky, degrees."""
CLEARANCE = 0.02
"""Distance from the image of any sparse point, as a fraction of the longer side."""
MARGIN = 2
"""Pixels by which regions are eroded."""
LEAST_KNOWN = 0.5
"""Share of known depths from which a pixel of the reduced photo is no sky."""
LEAST_SHARE = 0.01
"""Smallest area of a region as a fraction of the photo."""


def find_sky_pixels(
    photo: UInt8[Tensor, "H W 3"],
    camera: Camera,
    points: Float[Tensor, "P 3"],
    known: Bool[Tensor, "H W"] | None = None,
) -> Bool[Tensor, "h w"]:
    """Pixels that certainly show sky: smooth regions above the horizon, at the border, without sparse points.

    Args:
        photo: RGB.
        camera: Its camera in the aligned frame, in which z points upwards.
        points: Sparse points of the scene; those behind other surfaces count as well.
        known: Pixels of which the depth is known, which are no sky; None without depth maps.

    Returns:
        The mask, reduced to at most `SIDE` pixels.
    """
    scale = min(1.0, SIDE / max(photo.shape[:2]))
    height, width = (max(1, round(side * scale)) for side in photo.shape[:2])
    camera = camera.resized(width, height)
    image = _reduced(photo.permute(2, 0, 1).float() / 255, height, width)
    allowed = _is_smooth(image) & _is_above(camera) & _is_free(camera, points)
    if known is not None:
        allowed &= (_reduced(known.float()[None], height, width)[0] < LEAST_KNOWN).numpy()
    # Continued beyond the image, so that regions keep its corners.
    opened = ndimage.binary_opening(np.pad(allowed, MARGIN, mode="edge"), iterations=MARGIN)
    labels = np.empty(allowed.shape, np.int32)
    ndimage.label(opened[MARGIN:-MARGIN, MARGIN:-MARGIN], output=labels)
    border = np.unique(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
    areas = ndimage.sum_labels(np.ones_like(labels), labels, np.arange(labels.max() + 1))
    chosen = [each for each in border if each and areas[each] >= LEAST_SHARE * labels.size]
    return torch.from_numpy(
        ndimage.binary_erosion(np.isin(labels, chosen), iterations=MARGIN, border_value=1)
    )


def _reduced(image: Float[Tensor, "C H W"], height: int, width: int) -> Float[Tensor, "C h w"]:
    return functional.interpolate(image[None], size=(height, width), mode="bilinear", antialias=True)[0]


def _is_smooth(image: Float[Tensor, "3 h w"]) -> np.ndarray:
    padded = functional.pad(image[None], (2, 2, 2, 2), mode="replicate")
    mean = functional.avg_pool2d(padded, 5, stride=1)
    variance = functional.avg_pool2d(padded.square(), 5, stride=1) - mean.square()
    return (variance[0].amax(dim=0) < SMOOTH**2).numpy()


def _is_above(camera: Camera) -> np.ndarray:
    rays = functional.normalize(camera.pixel_rays(), dim=-1) @ camera.viewmat[:3, :3]
    return (rays[..., 2] > np.sin(np.radians(LEAST_ELEVATION))).numpy()


def _is_free(camera: Camera, points: Float[Tensor, "P 3"]) -> np.ndarray:
    pixels, depths = camera.project(points)
    inside = (
        (depths > 0)
        & (pixels >= 0).all(dim=1)
        & (pixels < torch.tensor([camera.width, camera.height])).all(1)
    )
    x, y = pixels[inside].long().unbind(1)
    free = np.ones((camera.height, camera.width), bool)
    free[y.numpy(), x.numpy()] = False
    if free.all():
        return free
    return np.asarray(ndimage.distance_transform_edt(free)) > CLEARANCE * max(free.shape)
