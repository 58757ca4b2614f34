"""Counts how many training photos show each Gaussian, for dropout."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from wildgs.engine.density import ViewStatistics
from wildgs.engine.feed import PhotoFeed
from wildgs.engine.schedule import falls_on
from wildgs.geometry.camera import Camera
from wildgs.model.gaussians import Gaussians
from wildgs.rasterize import blend

LEAST_INTERVAL, COUNTS = 250, 12
"""Smallest number of steps between counts, and number of counts in a long run."""
MOST_VIEWS = 100
"""Number of photos, evenly distributed over the collection, that are counted; the result is extrapolated."""
SIDE = 0.5
"""Size at which Gaussians are projected, relative to the photos."""


def count_interval(steps: int) -> int:
    """Steps between counts in a run of `steps` steps."""
    return max(LEAST_INTERVAL, steps // COUNTS)


def is_due(step: int, taken: int, steps: int) -> bool:
    """Whether photos are counted before the step after `step`, which counts as `taken` steps."""
    return step > 0 and falls_on(step, taken, count_interval(steps))


def count_photos(gaussians: Gaussians, feed: PhotoFeed) -> Float[Tensor, "N"]:
    """Effective number of training photos that show each Gaussian.

    A photo counts by the Gaussian's blending weights w, summed over its pixels: (sum of w)^2 / (sum of w^2) over
    all photos (the effective sample size of Kish 1965) is K if K photos show the Gaussian equally large, and close
    to 1 if one photo shows it much larger than the others do. It is 0 if no photo shows it.

    Every rank renders a part of the photos.

    Args:
        gaussians: The Gaussians.
        feed: The photos' cameras, and the ranks that train.
    """
    count = len(feed.views)
    chosen = feed.views[:: -(-count // MOST_VIEWS)]
    total = gaussians.means.new_zeros(len(gaussians))
    squares = torch.zeros_like(total)
    for view in chosen[feed.team.rank :: feed.team.size]:
        camera = feed.camera(view)
        width, height = (max(1, round(SIDE * side)) for side in (camera.width, camera.height))
        weights = blending_weights(gaussians, camera.resized(width, height))
        total += weights
        squares += weights.square()
    pooled = feed.team.pool(ViewStatistics(total, squares, torch.zeros_like(total)))
    shown = pooled.demand.square() / pooled.seen.clamp_min(torch.finfo(total.dtype).tiny)
    return shown * (count / len(chosen))


def blending_weights(gaussians: Gaussians, camera: Camera) -> Float[Tensor, "N"]:
    """Sum over pixels of each Gaussian's blending weight."""
    with torch.no_grad():
        projection = gaussians.project(camera)
    colors = gaussians.means.new_ones(len(gaussians), 3).requires_grad_()
    with torch.enable_grad():
        blended = blend(projection, colors).colors[..., 0].sum()
    # The gradient of a blended colour is the blending weight.
    (gradient,) = torch.autograd.grad(blended, colors)
    return gradient[:, 0]
