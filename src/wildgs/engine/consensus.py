"""Compares the training photos with each other, so that masks do not hide what all of them show."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from wildgs.engine.feed import PhotoFeed
from wildgs.engine.schedule import falls_on
from wildgs.model.method import Method
from wildgs.priors.consensus import (
    NEIGHBOURS,
    consensus,
    doubts,
    nearest_depth,
    principal_directions,
    reduced,
)
from wildgs.priors.stereo.neighbours import choose_neighbours
from wildgs.progress import Counter
from wildgs.scene import Scene, View

BASIS_PHOTOS = 64
"""Number of photos from which principal components are computed."""
USUAL_FEW, USUAL_MANY = 0.18, 0.10
"""Share of hidden pixels up to which masks are trusted, with few photos and with many. Passers-by and coaches cover
a tenth of the photos of a crowded square. With few photos masks hide up to 16% at first, and consensus is less
reliable."""
FEW, MANY = 20, 60
"""Numbers of photos that count as few and as many; in between, the share is interpolated."""
RISE = 0.04
"""Further share of hidden pixels until consensus counts fully."""
MEMORY = 0.98
"""Weight of earlier photos in the running share of hidden pixels."""
CHECK_EVERY = 50
"""Interval of steps in which the share is read, which waits for the device."""


class Consensus:
    """What may be transient in the training photos, as far as masks need to be told.

    Masks are left alone while they hide no more than passers-by usually cover: where few photos are memorised,
    passers-by have to be found early, and consensus, which is coarse and needs many photos, misses small ones.
    Masks that hide more than that hide trees, façades or whole photos, and never show them again, because what is
    hidden is not learnt. From then on, evidence counts only where consensus is low. Photos are not compared before
    that.

    Attributes:
        usual: Share of hidden pixels up to which masks are trusted.
        doubts: Degree to which each photo may be transient, in cells, by its name; see `priors.consensus.doubts`.
        hidden: Running share of hidden pixels, and its maximum so far.
        largest: The maximum when it was last read.
        compared: Whether the photos have been compared.
    """

    def __init__(self, device: torch.device, photos: int, steps: int) -> None:
        """Starts with masks that have hidden nothing.

        Args:
            device: Device on which the share of hidden pixels is kept, so that nothing waits for it.
            photos: Number of training photos.
            steps: Number of steps in which masks are trained by evidence, and are watched.
        """
        self.usual = usual_share(photos)
        self.steps = steps
        self.doubts: dict[str, Float[Tensor, "_ _"]] = {}
        self.hidden = torch.zeros(2, device=device)
        self.largest = 0.0
        self.compared = False

    def is_missing(self, step: int, taken: int) -> bool:
        """Whether the photos have to be compared before the step after `step`, which counts as `taken` steps."""
        if step >= self.steps:
            return False
        if falls_on(step, taken, CHECK_EVERY):
            self.largest = float(self.hidden[1])
        return self.largest > self.usual and not self.compared

    def state(self) -> Float[Tensor, " 3"]:
        """What `restore` needs to continue in the same way."""
        return torch.cat([self.hidden.cpu(), torch.tensor([self.largest])])

    def restore(self, state: Float[Tensor, " 3"]) -> None:
        """Continues from `state`."""
        self.hidden = state[:2].to(self.hidden)
        self.largest = float(state[2])

    @torch.no_grad()
    def compare(self, method: Method, scene: Scene, feed: PhotoFeed, on_photo: Counter) -> None:
        """Compares the photos; without features of the method, nothing is known about them.

        Args:
            method: Provides the features.
            scene: The scene, whose points determine neighbours and depths.
            feed: The photos; unreadable ones are left out.
            on_photo: Called with (photos done, total number of photos).
        """
        self.compared = True
        views = scene.train_views
        stride = -(-len(views) // BASIS_PHOTOS)
        sample = [_features(method, feed, view) for view in views[::stride]]
        sample = [features for features in sample if features is not None]
        if not sample:
            return
        directions = principal_directions(sample)
        compared = []  # reduced one by one, since features are four times as large
        for view in views:
            features = _features(method, feed, view)
            compared.append(None if features is None else reduced(features, directions))
        points = scene.points.to(directions.device)
        found = {}
        for row, others in enumerate(choose_neighbours(scene, NEIGHBOURS)):
            mine, camera = compared[row], feed.camera(views[row])
            nearest = nearest_depth(camera, points)
            if mine is not None and nearest is not None:
                shown = [(compared[other], feed.camera(views[other])) for other in others]
                pairs = [(features, seen) for features, seen in shown if features is not None]
                found[views[row].name] = consensus(mine, camera, pairs, nearest)
            on_photo(row + 1, len(views))
        self.doubts = dict(zip(found, doubts(list(found.values())), strict=True))

    @torch.no_grad()
    def observe(self, visibility: Float[Tensor, "H W"], step: int) -> None:
        """Takes account of the mask of the photo of a step, without synchronisation."""
        if step >= self.steps:
            return
        share = torch.lerp((visibility < 0.5).float().mean(), self.hidden[0], MEMORY)
        self.hidden = torch.stack([share, torch.maximum(share, self.hidden[1])])

    @torch.no_grad()
    def doubt(self, name: str) -> Float[Tensor, "_ _"] | None:
        """Factor on the evidence in cells of a photo, 0 to 1; None for 1 everywhere."""
        found = self.doubts.get(name)
        if found is None:
            return None
        strength = min(max((self.largest - self.usual) / RISE, 0.0), 1.0)
        return 1 - strength * (1 - found)


def usual_share(photos: int) -> float:
    """Share of hidden pixels up to which masks are trusted, by the number of training photos."""
    many = min(max((photos - FEW) / (MANY - FEW), 0.0), 1.0)
    return USUAL_FEW + many * (USUAL_MANY - USUAL_FEW)


def _features(method: Method, feed: PhotoFeed, view: View) -> Float[Tensor, "C h w"] | None:
    return method.place_features(feed.photo(view)[0], view.name) if feed.is_readable(view) else None
