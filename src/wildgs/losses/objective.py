"""The paper's total loss, with its mask and depth terms."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from wildgs.losses.config import ObjectiveConfig
from wildgs.losses.evidence import proven_static
from wildgs.losses.photometric import masked_photometric


@dataclass
class Losses:
    """Terms of one step, unweighted, and their weighted sum.

    Attributes:
        image: L^I.
        mask: L^M; 0 where there is no mask to learn.
        depth: L^D and the error against metric depth; 0 where there is no estimate.
        total: ``L^I + λ^M L^M + λ^D L^D`` and the weighted error against metric depth, to be differentiated.
    """

    NAMES: ClassVar[tuple[str, ...]] = ("image", "mask", "depth", "total")

    image: Float[Tensor, ""]
    mask: Float[Tensor, ""]
    depth: Float[Tensor, ""]
    total: Float[Tensor, ""]

    def terms(self) -> dict[str, Float[Tensor, ""]]:
        """The four by name, without the autograd graph."""
        return {name: getattr(self, name).detach() for name in self.NAMES}

    def detached(self) -> Losses:
        """The same values without the autograd graph."""
        return Losses(**self.terms())

    def as_floats(self) -> dict[str, float]:
        """The four numbers for a log."""
        terms = self.terms()
        return dict(zip(terms, torch.stack([*terms.values()]).tolist(), strict=True))


def total_loss(
    config: ObjectiveConfig,
    progress: float,
    photo: Float[Tensor, "H W 3"],
    render: Float[Tensor, "H W 3"],
    *,
    visibility: Float[Tensor, "H W"] | None = None,
    keep: Bool[Tensor, "H W"] | None = None,
    depth: Float[Tensor, "H W"] | None = None,
    alpha: Float[Tensor, "H W"] | None = None,
    disparity: Float[Tensor, "H W"] | None = None,
    metric_depth: Float[Tensor, "H W"] | None = None,
    observations: Float[Tensor, "K 2"] | None = None,
    train_mask: bool = True,
    mask_threshold: float = 0.5,
) -> Losses:
    """The paper's L_total for one photo.

    Args:
        config: Weights.
        progress: Share of the training done, 0..1, for λ^M.
        photo: I in 0..1.
        render: Î.
        visibility: M as predicted; None for a method without a mask (all visible, no mask loss).
        keep: The user's own mask, False = ignore. Ignored pixels count in no term.
        depth: Rendered expected depth; the depth loss needs it and `disparity`.
        alpha: Accumulated alpha of the render; pixels below `min_alpha` are left out of the depth loss.
        disparity: Monocular estimate, 0 where there is none; None leaves the depth loss out.
        metric_depth: Depth in world units, 0 where there is none: where it is known, it takes the place of the
            monocular estimate.
        observations: Pixels (x, y) at which the photo shows triangulated points: the mask learns that these are
            static.
        train_mask: False passes no gradient to the mask (the pause after an opacity reset).
        mask_threshold: Th: the depth loss leaves out pixels whose M is not above it.

    Returns:
        All terms.
    """
    if visibility is not None and not train_mask:
        visibility = visibility.detach()
    proven = None if observations is None else proven_static(observations, *photo.shape[:2])
    image = _image_loss(config, photo, render, _kept(visibility, keep, photo), proven)
    total, zero = image, image.new_zeros(())
    mask = depth_term = zero
    if visibility is not None:
        mask = visibility_regularizer(visibility if keep is None else torch.where(keep, visibility, 1.0))
        total = total + config.mask_weight(progress) * mask
    if depth is not None and (disparity is not None or metric_depth is not None):
        selection = torch.ones_like(depth, dtype=torch.bool) if keep is None else keep
        if visibility is not None:
            selection = selection & (visibility.detach() > mask_threshold)
        if alpha is not None:
            selection = selection & (alpha.detach() > config.min_alpha)
        if metric_depth is not None:
            error = metric_error(depth, metric_depth, selection)
            depth_term, total = depth_term + error, total + config.metric_weight * error
            selection = selection & (metric_depth == 0)
        if disparity is not None:
            correlation = depth_correlation(depth, disparity, selection)
            depth_term, total = depth_term + correlation, total + config.depth_weight * correlation
    return Losses(image=image, mask=mask, depth=depth_term, total=total)


def _image_loss(
    config: ObjectiveConfig, photo: Tensor, render: Tensor, mask: Tensor | None, proven: Tensor | None
) -> Tensor:
    """L^I; its gradient to the mask is the formula's or the evidence, as configured."""
    if mask is None or config.mask_gradient == "evidence":
        return masked_photometric(photo, render, mask, config.weight_l1, proven=proven)
    mask = mask[..., None]
    return masked_photometric(photo * mask, render * mask, None, config.weight_l1)


def _kept(visibility: Tensor | None, keep: Tensor | None, photo: Tensor) -> Tensor | None:
    """The mask of the image loss: the predicted one, zero where the user's mask ignores."""
    if keep is None:
        return visibility
    return keep.to(photo.dtype) if visibility is None else visibility * keep


def visibility_regularizer(visibility: Float[Tensor, "H W"]) -> Float[Tensor, ""]:
    """``mean((1 - M)^2)``, the paper's L^M.

    Args:
        visibility: M, 1 where the photo shows the static scene.

    Returns:
        0 where all is visible, 1 where all is hidden.
    """
    return (1 - visibility).square().mean()


OUTLYING = 0.1
"""Share of the depth beyond which an error says more about the estimate than about the render."""


def metric_error(
    depth: Float[Tensor, "H W"], known: Float[Tensor, "H W"], selection: Bool[Tensor, "H W"]
) -> Float[Tensor, ""]:
    """Mean of ``e / (1 + e / OUTLYING)``, ``e = |known / depth - 1|`` being the relative error of inverse depth.

    Args:
        depth: Rendered expected depth, world units along the camera's z axis.
        known: Estimate in the same units; 0 where there is none.
        selection: Pixels that count. Passes no gradient.

    Returns:
        0 (equal) to `OUTLYING`; 0 where no pixel counts. The mean is over all pixels of the picture, so that photos
        of which little is known weigh little.
    """
    chosen = selection & (known > 0) & (depth.detach() > 0)
    error = (known / torch.where(chosen, depth, 1.0) - 1).abs()
    return torch.where(chosen, error / (1 + error / OUTLYING), 0.0).mean()


MIN_PIXELS = 64
_MIN_RELATIVE_VARIANCE = 1e-9  # float32 rounding of a constant map leaves about 1e-14


def depth_correlation(
    depth: Float[Tensor, "H W"],
    disparity: Float[Tensor, "H W"],
    selection: Bool[Tensor, "H W"],
    min_pixels: int = MIN_PIXELS,
) -> Float[Tensor, ""]:
    """``1 + ρ(depth, disparity)`` over the selected pixels, ρ being Pearson's correlation (the paper's L^D).

    A monocular network gives disparity (large = near), so right geometry has ρ near -1. Pixels without an
    estimate (disparity 0) are left out. Where fewer than `min_pixels` remain or one of the maps is constant,
    ρ has no meaning: the loss is 0 and has no gradient.

    Args:
        depth: Rendered expected depth, world units along the camera's z axis.
        disparity: Estimate in arbitrary scale and shift; 0 where there is none.
        selection: Pixels that count: static (``M > Th``) and covered by the render. Passes no gradient.
        min_pixels: Fewest pixels that make a correlation.

    Returns:
        0 (same order and linear) to 2 (inverted).
    """
    chosen = selection & (disparity > 0)
    count = chosen.sum()
    divisor = count.clamp(min=1)
    depth_offset, depth_variance, depth_power = _centred(depth, chosen, divisor)
    estimate_offset, estimate_variance, estimate_power = _centred(disparity.to(depth), chosen, divisor)
    meaningful = (
        (count >= min_pixels)
        & (depth_variance > _MIN_RELATIVE_VARIANCE * depth_power)
        & (estimate_variance > _MIN_RELATIVE_VARIANCE * estimate_power)
    )
    # Replaced before the root and the division: their gradients at 0 would be NaN even where unused.
    variances = torch.where(meaningful, depth_variance * estimate_variance, 1.0)
    correlation = (depth_offset * estimate_offset).sum() / divisor / variances.sqrt()
    return torch.where(meaningful, 1 + correlation, 0.0)


def _centred(values: Tensor, chosen: Tensor, count: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Offsets from the mean at chosen pixels (0 elsewhere), their variance and the squares' mean."""
    values = torch.where(chosen, values, 0.0)
    values = values / values.detach().abs().amax().clamp(min=torch.finfo(values.dtype).tiny)
    mean = values.sum() / count
    offset = torch.where(chosen, values - mean, 0.0)
    return offset, offset.square().sum() / count, values.detach().square().sum() / count
