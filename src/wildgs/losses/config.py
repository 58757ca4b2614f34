"""Configuration of the objective."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ObjectiveConfig:
    """Weights of the total loss (paper's equation of L_total).

    Attributes:
        weight_l1: λ^I, share of L1 against structural dissimilarity in the image loss.
        mask_weight_start: λ^M at the first step.
        mask_weight_end: λ^M at the last step; linear in between.
        depth_weight: λ^D (paper: 0.05).
        mask_threshold: Th, above which a pixel counts as static for the depth loss.
        min_alpha: Least accumulated alpha of a pixel whose rendered depth is compared.
    """

    weight_l1: float = 0.8
    mask_weight_start: float = 0.4
    mask_weight_end: float = 0.1
    depth_weight: float = 0.01
    mask_threshold: float = 0.5
    min_alpha: float = 0.5

    def mask_weight(self, progress: float) -> float:
        """λ^M at a share of the training, 0 at its start and 1 at its end (clamped)."""
        share = min(max(progress, 0.0), 1.0)
        return self.mask_weight_start + (self.mask_weight_end - self.mask_weight_start) * share
