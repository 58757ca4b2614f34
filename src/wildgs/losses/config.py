"""Configuration of the objective."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class ObjectiveConfig:
    """Weights of the total loss (paper's equation of L_total).

    Attributes:
        weight_l1: λ^I, share of L1 against structural dissimilarity in the image loss.
        mask_weight_start: λ^M at the first step.
        mask_weight_end: λ^M at the last step; linear in between.
        depth_weight: λ^D (paper: 0.05).
        metric_weight: Weight of the error against metric depth, where there is any. Not in the paper.
        mask_gradient: What the mask learns from in the image loss. 'loss': the formula's own gradient, as printed;
            'evidence': what the pixel shows (`wildgs.losses.photometric.transient_evidence`). The value of the loss
            and its gradient to the render are the same.
        min_alpha: Least accumulated alpha of a pixel whose rendered depth is compared.
    """

    weight_l1: float = 0.8
    mask_weight_start: float = 0.4
    mask_weight_end: float = 0.1
    depth_weight: float = 0.01
    metric_weight: float = 0.1
    mask_gradient: Literal["evidence", "loss"] = "evidence"
    min_alpha: float = 0.5

    def mask_weight(self, progress: float) -> float:
        """λ^M at a share of the training, 0 at its start and 1 at its end (clamped)."""
        share = min(max(progress, 0.0), 1.0)
        return self.mask_weight_start + (self.mask_weight_end - self.mask_weight_start) * share
