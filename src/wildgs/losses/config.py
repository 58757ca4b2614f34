"""Configuration of the objective."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class ObjectiveConfig:
    """Weights of the total loss L_total.

    Attributes:
        weight_l1: λ^I, weight of L1 in the image loss; D-SSIM has 1 - λ^I.
        mask_weight_start: λ^M at the first step.
        mask_weight_end: λ^M at the last step in which the mask is trained; linear in between.
        mask_weight_photos: Number of training photos from which on λ^M starts at `mask_weight_start`. With fewer
            photos it starts lower (at `mask_weight_end` with two thirds as many), because a few photos are
            memorised, including passers-by, before the mask has found them. 0 disables this. Not in the
            paper.
        mask_power: Exponent of M in the image loss (paper: 1). Above 1, pixels that the mask is unsure of have
            little weight.
        depth_weight: λ^D (paper: 0.05).
        metric_weight: Weight of the loss against metric depth, for scenes that have it. Not in the paper.
        sky_weight: Weight of the loss on Gaussians in front of the sky. Not in the paper.
        opaque_weight: Weight of the mean of 1 - alpha in scenes with sky Gaussians, where every pixel shows
            something. Otherwise, Gaussians that are transparent before the black background represent what is dark.
            Not in the paper.
        mask_gradient: Gradient of the image loss to the mask. 'loss': the derivative of the paper's formula;
            'evidence': a robust measure of how transient a pixel is
            (`wildgs.losses.evidence.transient_evidence`). Neither changes the loss nor its gradient to the
            render.
        consensus: Whether, once masks hide more than passers-by usually cover, evidence counts only where other
            photos do not show the same (`wildgs.priors.consensus`). Needs a frozen encoder. Not in the paper.
        free_space: Whether what a photo shows in space that other photos see through, by depth priors, counts as
            evidence (`wildgs.priors.free_space`). Not in the paper.
        min_alpha: Smallest accumulated alpha of a pixel that enters the depth loss.
    """

    weight_l1: float = 0.8
    mask_weight_start: float = 0.4
    mask_weight_end: float = 0.1
    mask_weight_photos: int = 50
    mask_power: float = 3.0
    depth_weight: float = 0.01
    metric_weight: float = 0.1
    sky_weight: float = 1.0
    opaque_weight: float = 0.03
    mask_gradient: Literal["evidence", "loss"] = "evidence"
    consensus: bool = True
    free_space: bool = True
    min_alpha: float = 0.5

    def mask_weight(self, progress: float, num_photos: int | None = None) -> float:
        """λ^M at one step.

        Args:
            progress: Fraction of the mask's training, 0 at its start and 1 at its end (clamped).
            num_photos: Number of training photos; None for enough of them.
        """
        start = self.mask_weight_start
        if num_photos is not None and num_photos < self.mask_weight_photos:
            beyond_few = max(3 * num_photos / self.mask_weight_photos - 2, 0.0)
            start = self.mask_weight_end + (start - self.mask_weight_end) * beyond_few
        share = min(max(progress, 0.0), 1.0)
        return start + (self.mask_weight_end - start) * share
