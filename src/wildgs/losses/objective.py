"""The total loss with its image, mask and depth terms."""

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
        mask: L^M; 0 without a mask.
        depth: L^D plus the error against metric depth; 0 without depth maps.
        total: ``L^I + λ^M L^M + λ^D L^D`` plus the weighted error against metric depth, the loss in front of the
            sky and the mean transparency.
    """

    NAMES: ClassVar[tuple[str, ...]] = ("image", "mask", "depth", "total")

    image: Float[Tensor, ""]
    mask: Float[Tensor, ""]
    depth: Float[Tensor, ""]
    total: Float[Tensor, ""]

    def terms(self) -> dict[str, Float[Tensor, ""]]:
        """The four terms by name, detached."""
        return {name: getattr(self, name).detach() for name in self.NAMES}

    def detached(self) -> Losses:
        """All terms, detached."""
        return Losses(**self.terms())

    def as_floats(self) -> dict[str, float]:
        """The four terms as floats."""
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
    sky: Bool[Tensor, "H W"] | None = None,
    sky_depth: float = 0.0,
    observations: Float[Tensor, "K 2"] | None = None,
    static: Bool[Tensor, "H W"] | None = None,
    train_mask: bool = True,
    mask_threshold: float = 0.5,
    num_photos: int | None = None,
    doubt: Float[Tensor, "_ _"] | None = None,
    foreground: Float[Tensor, "_ _"] | None = None,
) -> Losses:
    """The paper's L_total for one photo.

    Args:
        config: Weights.
        progress: Fraction of the mask's training done, 0 to 1, for λ^M.
        photo: I, RGB in [0, 1].
        render: Î.
        visibility: Predicted mask M; None for a method without a mask.
        keep: The user's mask: False = ignore the pixel in all terms.
        depth: Rendered expected depth.
        alpha: Accumulated alpha of the render, for the loss of transparency; the depth loss ignores pixels below
            `min_alpha`.
        disparity: Monocular estimate, 0 where missing; None for a photo without it.
        metric_depth: Depth in world units, 0 where missing; used instead of the monocular estimate where it exists.
        sky: Pixels that certainly show sky; those that the user's mask leaves out are ignored.
        sky_depth: Rendered depth below which something is in front of the sky.
        observations: Pixels (x, y) at which the photo observes triangulated points, which are static.
        static: Further pixels that are known to be static.
        train_mask: Whether the mask gets a gradient (False in the pause after an opacity reset).
        mask_threshold: Threshold Th of static pixels for the depth loss.
        num_photos: Number of training photos, on which λ^M depends; None for enough of them.
        doubt: Degree to which pixels may be transient, in cells; see `masked_photometric`.
        foreground: Degree to which pixels are transient for another reason, in cells; see `masked_photometric`.

    Returns:
        All terms.
    """
    return weighted_losses(
        config,
        photo,
        render,
        config.mask_weight(progress, num_photos),
        sky_depth,
        visibility=visibility if train_mask or visibility is None else visibility.detach(),
        keep=keep,
        depth=depth,
        alpha=alpha,
        disparity=disparity,
        metric_depth=metric_depth,
        sky=sky,
        proven=None if observations is None else proven_static(observations, *photo.shape[:2]),
        static=static,
        mask_threshold=mask_threshold,
        doubt=doubt,
        foreground=foreground,
    )


def weighted_losses(
    config: ObjectiveConfig,
    photo: Float[Tensor, "H W 3"],
    render: Float[Tensor, "H W 3"],
    mask_weight: float | Float[Tensor, ""],
    sky_depth: float | Float[Tensor, ""],
    *,
    visibility: Float[Tensor, "H W"] | None = None,
    keep: Bool[Tensor, "H W"] | None = None,
    depth: Float[Tensor, "H W"] | None = None,
    alpha: Float[Tensor, "H W"] | None = None,
    disparity: Float[Tensor, "H W"] | None = None,
    metric_depth: Float[Tensor, "H W"] | None = None,
    sky: Bool[Tensor, "H W"] | None = None,
    proven: Bool[Tensor, "H W"] | None = None,
    static: Bool[Tensor, "H W"] | None = None,
    mask_threshold: float = 0.5,
    doubt: Float[Tensor, "_ _"] | None = None,
    foreground: Float[Tensor, "_ _"] | None = None,
) -> Losses:
    """`total_loss` where all that changes from step to step is a tensor, for CUDA graphs.

    Args:
        config: Weights.
        photo: I.
        render: Î.
        mask_weight: λ^M.
        sky_depth: As in `total_loss`, like all arguments without another remark.
        visibility: Predicted mask M, detached if it does not learn.
        keep: The user's mask.
        depth: Rendered expected depth.
        alpha: Accumulated alpha.
        disparity: Monocular estimate.
        metric_depth: Depth in world units.
        sky: Pixels that certainly show sky.
        proven: Pixels known to be static by observations (`proven_static`).
        static: Further pixels known to be static.
        mask_threshold: Threshold Th.
        doubt: Degree to which pixels may be transient.
        foreground: Degree to which pixels are transient for another reason.
    """
    if static is not None:
        proven = static if proven is None else static | proven
    image = _image_loss(config, photo, render, _kept(visibility, keep, photo), proven, doubt, foreground)
    total, zero = image, image.new_zeros(())
    mask = depth_term = zero
    if visibility is not None:
        mask = visibility_regularizer(visibility if keep is None else torch.where(keep, visibility, 1.0))
        total = total + mask_weight * mask
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
    if depth is not None and sky is not None:
        free = sky if keep is None else sky & keep
        total = total + config.sky_weight * nearness(depth, free, sky_depth)
    if alpha is not None and config.opaque_weight:
        total = total + config.opaque_weight * transparency(alpha, keep)
    return Losses(image=image, mask=mask, depth=depth_term, total=total)


def _image_loss(
    config: ObjectiveConfig,
    photo: Tensor,
    render: Tensor,
    mask: Tensor | None,
    proven: Tensor | None,
    doubt: Tensor | None,
    foreground: Tensor | None,
) -> Tensor:
    """L^I, with the configured gradient to the mask."""
    if mask is None or config.mask_gradient == "evidence":
        return masked_photometric(
            photo,
            render,
            mask,
            config.weight_l1,
            power=config.mask_power,
            proven=proven,
            doubt=doubt,
            foreground=foreground,
        )
    mask = mask[..., None] ** config.mask_power
    return masked_photometric(photo * mask, render * mask, None, config.weight_l1)


def _kept(visibility: Tensor | None, keep: Tensor | None, photo: Tensor) -> Tensor | None:
    """The mask of the image loss: the predicted mask, zero where the user's mask is False."""
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


def transparency(alpha: Float[Tensor, "H W"], keep: Bool[Tensor, "H W"] | None) -> Float[Tensor, ""]:
    """Mean of ``1 - alpha`` over all pixels, without those that the user's mask leaves out.

    Args:
        alpha: Accumulated alpha.
        keep: The user's mask; gets no gradient.

    Returns:
        0 where nothing is transparent, 1 where nothing is rendered.
    """
    clear = 1 - alpha
    return (clear if keep is None else torch.where(keep, clear, 0.0)).mean()


def nearness(
    depth: Float[Tensor, "H W"], sky: Bool[Tensor, "H W"], far: float | Float[Tensor, ""]
) -> Float[Tensor, ""]:
    """Mean over all pixels of ``1 - depth / far`` where the photo shows sky and the render is nearer than `far`.

    The rendered depth is that of the distant shell if nothing is in front of it.

    Args:
        depth: Rendered expected depth, units of the aligned frame.
        sky: Pixels that show sky; gets no gradient.
        far: Depth from which nothing is in front of the sky, in the same units.
    """
    return torch.where(sky, (1 - depth / far).clamp_min(0), 0.0).mean()


OUTLYING = 0.1
"""Relative error at which the robust loss reaches half of its maximum, as the estimate is probably an outlier."""


def metric_error(
    depth: Float[Tensor, "H W"], estimate: Float[Tensor, "H W"], selection: Bool[Tensor, "H W"]
) -> Float[Tensor, ""]:
    """Mean of ``e / (1 + e / OUTLYING)`` with the relative error of inverse depth ``e = |estimate / depth - 1|``.

    Args:
        depth: Rendered expected depth, world units along the camera's z axis.
        estimate: Estimated depth in the same units; 0 where missing.
        selection: Pixels to compare; gets no gradient.

    Returns:
        0 (equal) to `OUTLYING`; 0 without pixels. The mean is over all pixels of the image, so that photos with few
        estimates have a low weight.
    """
    chosen = selection & (estimate > 0) & (depth.detach() > 0)
    error = (estimate / torch.where(chosen, depth, 1.0) - 1).abs()
    return torch.where(chosen, error / (1 + error / OUTLYING), 0.0).mean()


MIN_PIXELS = 64
_MIN_RELATIVE_VARIANCE = 1e-9  # float32 rounding of a constant map leaves about 1e-14


def depth_correlation(
    depth: Float[Tensor, "H W"],
    disparity: Float[Tensor, "H W"],
    selection: Bool[Tensor, "H W"],
    min_pixels: int = MIN_PIXELS,
) -> Float[Tensor, ""]:
    """``1 + ρ(depth, disparity)`` over the selected pixels with Pearson's correlation ρ (the paper's L^D).

    Monocular networks predict disparity (large = near), so that ρ is close to -1 for correct geometry. Pixels
    without an estimate (disparity 0) are ignored. If fewer than `min_pixels` remain or one of the maps is constant,
    the loss is 0 and has no gradient.

    Args:
        depth: Rendered expected depth, world units along the camera's z axis.
        disparity: Estimate of arbitrary scale and shift; 0 where missing.
        selection: Pixels to compare: static (``M > Th``) and covered by the render. Gets no gradient.
        min_pixels: Smallest number of pixels for a correlation.

    Returns:
        0 (perfect anticorrelation) to 2 (perfect correlation).
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
    # Replaced before root and division, whose gradients at 0 would be NaN even if unused.
    variances = torch.where(meaningful, depth_variance * estimate_variance, 1.0)
    correlation = (depth_offset * estimate_offset).sum() / divisor / variances.sqrt()
    return torch.where(meaningful, 1 + correlation, 0.0)


def _centred(values: Tensor, chosen: Tensor, count: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Deviations from the mean at chosen pixels (0 elsewhere), their variance, and the mean square."""
    values = torch.where(chosen, values, 0.0)
    values = values / values.detach().abs().amax().clamp(min=torch.finfo(values.dtype).tiny)
    mean = values.sum() / count
    offset = torch.where(chosen, values - mean, 0.0)
    return offset, offset.square().sum() / count, values.detach().square().sum() / count
