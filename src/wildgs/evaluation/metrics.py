"""Metrics of renders (PSNR, SSIM, detail) on images rounded to 8 bits, and of transient masks (AP, IoU)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from scipy.ndimage import distance_transform_edt, gaussian_filter
from torch import Tensor

from wildgs.losses.ssim import ssim_map

_BINS = 1 << 16
MAX_PSNR = 100.0
"""PSNR of identical images in dB, so that means stay finite."""
LANDMARK_REACH = 0.03
"""Pixels this close to a triangulated observation, relative to the longer side, belong to the landmark."""
LEAST_OBSERVATIONS = 20
"""Minimum number of observations to determine which pixels show the landmark."""
LEAST_LANDMARK_PIXELS = 50
DETAIL_SIGMA = 1.5
"""Standard deviation in pixels of the Gaussian that separates low from high frequencies."""


def to_8bit(picture: Float[Tensor, "H W 3"]) -> UInt8[Tensor, "H W 3"]:
    """Clamps to [0, 1] and rounds to 8 bits, as in an image file; NaN becomes black."""
    return (picture.nan_to_num(0.0, 1.0, 0.0).clamp(0, 1) * 255).round().to(torch.uint8)


def psnr(
    render: UInt8[Tensor, "H W 3"],
    truth: UInt8[Tensor, "H W 3"],
    keep: Bool[Tensor, "H W"] | None = None,
) -> float:
    """Peak signal-to-noise ratio from the mean squared error over all pixels and channels.

    Args:
        render: Picture to score.
        truth: Ground truth.
        keep: Pixels that count; None for all.

    Returns:
        PSNR in dB, at most `MAX_PSNR`.
    """
    square = ((render.double() - truth.double()) / 255).square()
    error = (square if keep is None else square[keep]).mean()
    return min(float(-10 * torch.log10(error)), MAX_PSNR)


def structural_similarity(
    render: UInt8[Tensor, "H W 3"],
    truth: UInt8[Tensor, "H W 3"],
    keep: Bool[Tensor, "H W"] | None = None,
) -> float:
    """SSIM as 3DGS reports it: Gaussian window of 11, sigma 1.5, data range 1, double precision.

    Borders are padded with zeros as in 3DGS (other implementations crop 5 pixels instead), and moments are biased.
    The map is averaged over pixels and channels.

    Args:
        render: Picture to score.
        truth: Ground truth.
        keep: Pixels whose windows count; None for all.
    """
    similarity = ssim_map(render.double() / 255, truth.double() / 255)
    return float((similarity if keep is None else similarity[keep]).mean())


def landmark_pixels(observed: Float[Tensor, "K 2"], height: int, width: int) -> Bool[Tensor, "H W"] | None:
    """Mask of the pixels that show the landmark: those close to a triangulated observation.

    Args:
        observed: Observations of the photo (x, y), pixels.
        height: Height of the photo.
        width: Width of the photo.

    Returns:
        None for a photo with fewer than `LEAST_OBSERVATIONS` observations.
    """
    if len(observed) < LEAST_OBSERVATIONS:
        return None
    away = np.ones((height, width), dtype=bool)
    x, y = observed.cpu().long().unbind(1)
    away[y, x] = False
    distance = np.asarray(distance_transform_edt(away))
    return torch.from_numpy(distance < LANDMARK_REACH * max(height, width))


class Detail(NamedTuple):
    """Comparison of the high frequencies of a render's luminance with those of the ground truth.

    Attributes:
        energy: Ratio of their standard deviations: below 1 the render is blurred, above 1 it is noisy.
        correlation: Their correlation; 1 if the render has exactly the detail of the ground truth.
    """

    energy: float | None
    correlation: float | None


def detail(
    render: UInt8[Tensor, "H W 3"], truth: UInt8[Tensor, "H W 3"], keep: Bool[Tensor, "H W"] | None = None
) -> Detail:
    """Compares high frequencies, after the affine colour map that fits the render best to the ground truth.

    Args:
        render: Image to score.
        truth: Ground truth.
        keep: Mask of the pixels to score; None for all.

    Returns:
        The comparison; None values if one of the images has no high frequencies.
    """
    chosen = np.ones(render.shape[:2], dtype=bool) if keep is None else keep.cpu().numpy()
    drawn, true = (picture.cpu().numpy().astype(np.float64) / 255 for picture in (render, truth))
    with_offset = np.concatenate([drawn, np.ones_like(drawn[..., :1])], axis=2)
    color_map = np.linalg.lstsq(with_offset[chosen], true[chosen], rcond=None)[0]
    first, second = (_high_frequencies(picture)[chosen] for picture in (with_offset @ color_map, true))
    spread = float(first.std()), float(second.std())
    if min(spread) < 1e-9:
        return Detail(None, None)
    return Detail(spread[0] / spread[1], float((first * second).mean()) / (spread[0] * spread[1]))


def _high_frequencies(picture: Float[np.ndarray, "H W 3"]) -> Float[np.ndarray, "H W"]:
    grey = picture.mean(axis=2)
    return grey - gaussian_filter(grey, DETAIL_SIGMA)


class MaskScore:
    """Scores of predicted transient masks against the ground truth, pooled over the pixels of all photos.

    Transient pixels are positives with score ``1 - M``. Scores are counted in a histogram of 65,536 bins, so that
    memory does not grow with the number of photos.
    """

    def __init__(self, threshold: float = 0.5) -> None:
        """Args: threshold: Th; a pixel is predicted transient where ``M <= Th``, as in lifting."""
        self.threshold = threshold
        self.images = 0
        self._counts = torch.zeros(2, _BINS, dtype=torch.float64)
        self._both = 0
        self._either = 0

    def add(self, visibility: Float[Tensor, "H W"], static: Bool[Tensor, "H W"]) -> None:
        """Adds one photo.

        Args:
            visibility: Predicted mask M, 1 = static.
            static: Ground truth.
        """
        transient_score = (1 - visibility.detach().cpu().double()).clamp(0, 1)
        bins = (transient_score * (_BINS - 1)).round().long().flatten()
        truth = ~static.cpu().flatten()
        for row, chosen in enumerate((~truth, truth)):
            self._counts[row] += torch.bincount(bins[chosen], minlength=_BINS)
        predicted = (visibility.detach() <= self.threshold).cpu().flatten()
        self._both += int((predicted & truth).sum())
        self._either += int((predicted | truth).sum())
        self.images += 1

    @property
    def average_precision(self) -> float | None:
        """Average precision Σ (R_n - R_{n-1}) P_n over thresholds, as in scikit-learn; None without transients."""
        negatives, positives = self._counts.flip(1).cumsum(1)
        total = positives[-1]
        if total == 0:
            return None
        precision = positives / (positives + negatives).clamp(min=1)
        gained = torch.diff(positives, prepend=positives.new_zeros(1)) / total
        return float((gained * precision).sum())

    @property
    def iou(self) -> float | None:
        """Intersection over union of predicted and true transients; None if there are none."""
        return self._both / self._either if self._either else None

    def as_dict(self) -> dict[str, float | int | None]:
        """Content of ``masks`` in `metrics.json`."""
        return {"average_precision": self.average_precision, "iou": self.iou, "images": self.images}
