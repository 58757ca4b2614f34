"""Scores of predicted transient masks against the truth."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

_BINS = 1 << 16


class MaskScore:
    """Pools pixels of many photos; memory does not grow with them.

    A transient pixel is a positive, and ``1 - M`` is its score. Scores are sorted into 65,536 bins; smaller
    differences are ties.
    """

    def __init__(self, threshold: float = 0.5) -> None:
        """Args: threshold: Th; a pixel is predicted transient where ``M <= Th``, as in lifting."""
        self.threshold = threshold
        self.images = 0
        self._counts = torch.zeros(2, _BINS, dtype=torch.float64)
        self._both = 0
        self._either = 0

    def add(self, visibility: Float[Tensor, "H W"], static: Bool[Tensor, "H W"]) -> None:
        """Count one photo.

        Args:
            visibility: M, 1 = static.
            static: The truth.
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
        """Σ (R_n - R_{n-1}) P_n over all thresholds (scikit-learn's definition); None without transients."""
        negatives, positives = self._counts.flip(1).cumsum(1)
        total = positives[-1]
        if total == 0:
            return None
        precision = positives / (positives + negatives).clamp(min=1)
        gained = torch.diff(positives, prepend=positives.new_zeros(1)) / total
        return float((gained * precision).sum())

    @property
    def iou(self) -> float | None:
        """Intersection over union of predicted and true transients; None where neither has any."""
        return self._both / self._either if self._either else None

    def as_dict(self) -> dict[str, float | int | None]:
        """What `metrics.json` holds under ``masks``."""
        return {"average_precision": self.average_precision, "iou": self.iou, "images": self.images}
