"""Counts how many training photos show each Gaussian, for dropout and the flat ground."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from wildgs.engine.density import ViewStatistics
from wildgs.engine.feed import PhotoFeed
from wildgs.engine.schedule import falls_on
from wildgs.geometry.camera import Camera
from wildgs.model.config import DropoutConfig
from wildgs.model.dropout import dropout_rates
from wildgs.model.gaussians import Gaussians
from wildgs.model.method import Method
from wildgs.rasterize import blend

LEAST_INTERVAL, COUNTS = 250, 12
"""Smallest number of steps between counts, and number of counts in a long run."""
MOST_VIEWS = 100
"""Number of photos, evenly distributed over the collection, that are counted; the result is extrapolated."""
SIDE = 0.5
"""Size at which Gaussians are projected, relative to the photos."""


class PhotoCounts:
    """Keeps the numbers of photos that show each Gaussian up to date in training, and derives dropout rates."""

    def __init__(self, method: Method, config: DropoutConfig, steps: int, *, needed: bool = False) -> None:
        """Starts without numbers, hence without dropout.

        Args:
            method: The method; the numbers are kept as `Gaussians.photos`, which density control edits.
            config: Options of dropout.
            steps: Number of steps of the run.
            needed: Whether photos are counted even without dropout.
        """
        self._method, self._config, self._steps = method, config, steps
        self._drops = method.uses_dropout and config.rate > 0
        self._counts = self._drops or needed

    def update(self, step: int, feed: PhotoFeed) -> None:
        """Counts before the step after `step`, if it is time."""
        if self._counts and is_due(step, feed.team.size, self._steps):
            self._method.gaussians.photos = count_photos(self._method.gaussians, feed)

    def dropout_rates(self) -> Float[Tensor, "N"] | None:
        """Probability of each Gaussian to be dropped; None without dropout, and before the first count."""
        photos = self._method.gaussians.photos
        return dropout_rates(self._config, photos) if self._drops and photos is not None else None

    def state(self) -> dict[str, Tensor]:
        """What `restore` needs to continue in the same way."""
        photos = self._method.gaussians.photos
        return {} if photos is None else {"photos": photos}

    def restore(self, state: dict[str, Tensor]) -> None:
        """Continues from `state`."""
        photos, gaussians = state.get("photos"), self._method.gaussians
        gaussians.photos = None if photos is None else photos.to(gaussians.means.device)


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
