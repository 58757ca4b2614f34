"""What photos show in space that other photos see through: passers-by and coaches, found by depth maps alone.

Not in the paper. A coach of one colour before a blurred façade differs little from the render of a light that is
green near the ground. Its depth tells more: a depth prior, aligned to the sparse points, says that it is nearer
than what other photos show behind the same place. Nothing needs to be trained for this comparison, which is that of
multi-view stereo: Merrell et al. 2007, Real-Time Visibility-Based Fusion of Depth Maps.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from wildgs.errors import UserError
from wildgs.geometry.camera import Camera
from wildgs.priors.depth_points import aligned_depth, sample_at
from wildgs.priors.stereo.neighbours import choose_neighbours
from wildgs.progress import Counter
from wildgs.scene.scene import Scene, View

SIDE = 120
"""Longer side, in pixels, to which depth maps are reduced."""
SAMPLE, AHEAD = 16, 4
"""Number of photos of which none has a depth prior if the scene has none; photos that are decoded in advance."""
NEIGHBOURS = 24
"""Upper bound on the number of photos with which each photo is compared."""
THROUGH = 1.35
"""A photo sees through a place if its depth there is more than this many times that of the place."""
AGREEING = 0.2
"""A photo shows the same place if its depth there differs by less than this share."""
LEAST_PHOTOS = 2
"""Number of photos that have to see through a place."""
DOUBTFUL, CERTAIN = 0.5, 0.8
"""Of the photos that see through a place or show it, share of the former up to which the place is static, and from
which it is transient."""
MOST = 0.6
"""Share of a photo's known depths in free space from which its depth map is taken to be wrong instead."""


@dataclass(frozen=True)
class _Depths:
    """Reduced depth maps of a photo, 0 = unknown.

    Attributes:
        camera: Its camera, of the size of the maps.
        prior: Depth by a depth prior, which may show passers-by.
        known: The same, and metric depth, on which several photos already agreed.
    """

    camera: Camera
    prior: Float[Tensor, "h w"]
    known: Float[Tensor, "h w"]


@torch.no_grad()
def find_foregrounds(scene: Scene, on_photo: Counter) -> dict[str, Float[Tensor, "h w"]]:
    """Degree to which each training photo shows something in space that other photos see through.

    Args:
        scene: A scene, with depth priors or without.
        on_photo: Called with (photos done, total number of photos) while depth maps are read.

    Returns:
        Maps from 0 to 1, of at most `SIDE` pixels, by the photo's name; 0 where the photo has no depth prior that
        can be aligned. Empty if nothing is in free space in any photo. Unreadable photos are left out.
    """
    views = scene.train_views
    if not any(_has_prior(view) for view in views[:: -(-len(views) // SAMPLE)]):
        return {}
    depths = []
    for row, view in enumerate(views):
        for coming in views[row + 1 : row + 1 + AHEAD]:
            coming.prefetch()
        depths.append(_read(scene, view))
        on_photo(row + 1, len(views))
    if not any(each is not None and each.prior.any() for each in depths):
        return {}
    found = {}
    for view, mine, others in zip(views, depths, choose_neighbours(scene, NEIGHBOURS), strict=True):
        if mine is not None:
            found[view.name] = _foreground(mine, [other for row in others if (other := depths[row])])
    return found if any(each.any() for each in found.values()) else {}


def _has_prior(view: View) -> bool:
    try:
        return view.read_disparity() is not None
    except UserError:
        return False


def _read(scene: Scene, view: View) -> _Depths | None:
    """The depth maps of a photo; None if the photo cannot be read any more."""
    try:
        maps = aligned_depth(scene, view, torch.Generator())
    except UserError:
        return None
    none = torch.zeros(view.camera.height, view.camera.width)
    metric, prior = (none if depth is None else depth for depth in maps)
    step = -(-max(none.shape) // SIDE)
    metric, prior = metric[::step, ::step], prior[::step, ::step].contiguous()
    known = torch.where(metric > 0, metric, prior)
    return _Depths(view.camera.resized(known.shape[1], known.shape[0]), prior, known)


def _foreground(mine: _Depths, others: list[_Depths]) -> Float[Tensor, "h w"]:
    """Degree to which each pixel is in free space, from 0 to 1."""
    points = mine.camera.unproject(mine.prior).flatten(0, 1)
    through, same = torch.zeros(len(points)), torch.zeros(len(points))
    for other in others:
        z, depth = sample_at(points, other.camera, other.known)
        ratio = torch.where(depth > 0, depth / z, 0.0)
        through += ratio > THROUGH
        same += (ratio - 1).abs() < AGREEING
    share = through / (through + same).clamp_min(1)
    degree = ((share - DOUBTFUL) / (CERTAIN - DOUBTFUL)).clamp(0, 1)
    known = mine.prior > 0
    degree = torch.where((through >= LEAST_PHOTOS).view_as(known) & known, degree.view_as(known), 0.0)
    wrong = float((degree > 0.5).sum()) > MOST * float(known.sum())
    return torch.zeros_like(degree) if wrong else degree
