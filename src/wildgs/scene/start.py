"""The photo with whose view a scene opens."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from wildgs.geometry.camera import Camera
from wildgs.scene.scene import Scene, View

_MIDDLE = 0.3
"""Half the side of the central part of an image in which the depth of the landmark is measured."""

_BORDER, _CUT = (-0.1, 1.1), (0.04, 0.96)
"""Outer and inner edge of the frame along the border of the image in which nothing of the landmark should be."""

_WHOLE = 4
"""Exponent of the share of the points that are not in this frame."""

_SPREAD = (0.05, 0.95)
"""Quantiles of the points between which they cover the image."""


def choose_start(scene: Scene) -> tuple[View, float]:
    """Chooses a photo that shows the landmark complete and large, as many other photos show it.

    The score of a photo is the product of the share of the points inside the image (small for cameras that are too
    close), the share of the image that they cover (small for those that are too far away), a power of the share of
    the points that are not near the border (small where the landmark is cut off), and the square root of the number
    of observations by other photos that this photo shares (small for unusual directions, and for photos that are
    blurred or covered). Points count by the number of photos that observe them.

    Args:
        scene: A scene with at least one photo.

    Returns:
        A training photo (any photo if there are none), and the depth of the landmark in its view.
    """
    weights, observed = _observations(scene)
    views = scene.train_views or scene.views
    numbers = {view.name: number for number, view in enumerate(scene.views)}
    scores = [
        _extent(view.camera, scene.points, weights) * float(observed[numbers[view.name]].sqrt())
        for view in views
    ]
    best = views[int(torch.tensor(scores).argmax())]
    return best, _depth(best.camera, scene.points)


def _observations(scene: Scene) -> tuple[Float[Tensor, " P"], Float[Tensor, " V"]]:
    """Number of photos that observe each point, and these numbers summed over the points of each photo.

    Both are 1 for a scene without observations.
    """
    if not len(scene.observations):
        return torch.ones(len(scene.points)), torch.ones(len(scene.views))
    photos, points = scene.observations.long().unique(dim=0).unbind(dim=1)
    weights = points.bincount(minlength=len(scene.points)).float()
    return weights, photos.bincount(weights[points], minlength=len(scene.views)).float()


def _project(camera: Camera, points: Float[Tensor, "P 3"]) -> tuple[Tensor, Tensor]:
    """Image coordinates (0 to 1 on each axis) and depths of points."""
    pixels, depths = camera.project(points)
    return pixels / torch.tensor([camera.width, camera.height]).to(points), depths


def _extent(camera: Camera, points: Float[Tensor, "P 3"], weights: Float[Tensor, " P"]) -> float:
    """How complete and large the points are in the image: the product of the first three factors of the score."""
    places, depths = _project(camera, points)
    seen = (depths > 1e-3) & (weights > 0)
    inside = seen & _within(places, (0.0, 1.0))
    if int(inside.sum()) < 2:
        return 0.0
    spread = torch.stack([_spread(axis, weights[inside]) for axis in places[inside].unbind(dim=1)])
    border = seen & _within(places, _BORDER) & ~_within(places, _CUT)
    complete, cut = (weights[chosen].sum() / weights.sum() for chosen in (inside, border))
    return float(complete * spread.prod().sqrt() * (1 - cut) ** _WHOLE)


def _within(places: Float[Tensor, "P 2"], limits: tuple[float, float]) -> Bool[Tensor, " P"]:
    return ((places >= limits[0]) & (places <= limits[1])).all(dim=1)


def _spread(values: Float[Tensor, " K"], weights: Float[Tensor, " K"]) -> Float[Tensor, ""]:
    """Distance between the outer quantiles of weighted values."""
    order = values.argsort()
    below = weights[order].cumsum(dim=0) / weights.sum()
    low, high = torch.searchsorted(below, torch.tensor(_SPREAD).to(below)).clamp(max=len(values) - 1)
    return values[order[high]] - values[order[low]]


def _depth(camera: Camera, points: Float[Tensor, "P 3"]) -> float:
    """Median depth of the points in the central part of the image."""
    places, depths = _project(camera, points)
    before = depths > 1e-3
    middle = before & ((places - 0.5).abs() < _MIDDLE).all(dim=1)
    chosen = depths[middle] if bool(middle.any()) else depths[before]
    return float(chosen.median()) if len(chosen) else 1.0
