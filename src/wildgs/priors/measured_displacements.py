"""Displacements of photos that structure from motion has measured: the smooth part of its residuals.

A residual is where a photo shows a point, less where the camera projects it. Most of it is noise of the feature
detector, which differs from feature to feature. What residuals of neighbouring features have in common says that
the photo is not where its camera says: lenses are not as simple as a camera model, and poses are not exact. Both
parts are estimated from the covariance of residuals by their distance. The smooth part is then interpolated by
simple kriging, which shrinks it to zero where there are few features.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.linalg import solve
from scipy.spatial.distance import cdist
from torch import Tensor

from wildgs.priors.config import CELLS, LEAST_SHARE
from wildgs.progress import in_threads
from wildgs.scene import View
from wildgs.scene.residuals import Residuals
from wildgs.threads import thread_count

MOST_POINTS = 800
"""Largest number of residuals of a photo that are used, chosen at random."""
MOST_PHOTOS = 200
"""Largest number of photos from which a covariance is estimated, at equal distances in the order of their names."""
LEAST_POINTS = 100
"""Smallest number of residuals of all photos from which a covariance is estimated."""
LEAST_NOISE = 0.01
"""Smallest share of noise in the variance: no feature is exact, and several may be at one place."""
EDGES = np.array([2, 4, 7, 11, 16, 23, 32, 45, 64]) / 320
"""Ends of the intervals of distance between features, in units of the photo's longer side."""
LENGTHS = np.array([8, 12, 18, 26, 36]) / 320
"""Lengths from which that of the covariance exp(-d²/2l²) is chosen."""


@dataclass(frozen=True)
class Covariance:
    """Covariance of residuals along one axis, in units of the squared longer side.

    Attributes:
        common: Variance of what neighbours have in common.
        noise: Variance of the rest.
        length: Distance at which the covariance has fallen to exp(-1/2).
    """

    common: float
    noise: float
    length: float

    @property
    def share(self) -> float:
        """Share of the variance that neighbours have in common."""
        return self.common / max(self.common + self.noise, 1e-20)

    def at(self, squared: Float[np.ndarray, "K L"]) -> Float[np.ndarray, "K L"]:
        """Covariance of the smooth part at squared distances."""
        return self.common * np.exp(squared / (-2 * self.length**2))


@dataclass(frozen=True)
class MeasuredDisplacements:
    """Displacements of photos.

    Attributes:
        grids: (x, y) in each cell of each photo, in units of its longer side: where the photo shows what the camera
            projects there.
        share: Share of the variance of residuals that neighbours have in common; 0 without residuals.
    """

    grids: Float[Tensor, "V 2 G G"]
    share: float


def measured_displacements(
    views: Sequence[View],
    residuals: Mapping[str, Residuals],
    cells: int = CELLS,
    least_share: float = LEAST_SHARE,
) -> MeasuredDisplacements:
    """Estimates how photos are displaced.

    Args:
        views: The photos.
        residuals: Residuals by the photos' names.
        cells: Number of cells along each side of a photo.
        least_share: Displacements are zero if neighbouring residuals have less than this share of the variance in
            common.
    """
    points = _points(views, residuals)
    covariance = _covariance(points)
    if covariance is None or covariance.share < least_share or covariance.common == 0:
        share = 0.0 if covariance is None else covariance.share
        return MeasuredDisplacements(torch.zeros(len(views), 2, cells, cells), share)

    def interpolate(row: int) -> Float[Tensor, "2 G G"]:
        camera = views[row].camera
        return _kriged(points[row], covariance, cells, camera.width, camera.height)

    grids = torch.stack(list(in_threads(interpolate, range(len(views)), thread_count())))
    return MeasuredDisplacements(grids, covariance.share)


Points = tuple[Float[np.ndarray, "_ 2"], Float[np.ndarray, "_ 2"]]
"""Places and offsets of residuals."""


def scene_covariance(views: Sequence[View], residuals: Mapping[str, Residuals]) -> Covariance | None:
    """Covariance of residuals of the same photo by their distance; None if there are too few.

    Args:
        views: The photos.
        residuals: Residuals by the photos' names.
    """
    return _covariance(_points(views, residuals))


def _covariance(photos: Sequence[Points]) -> Covariance | None:
    photos = photos[:: -(-len(photos) // MOST_PHOTOS) or 1]
    if sum(len(places) for places, _ in photos) < LEAST_POINTS:
        return None
    sums, counts = np.zeros((2, len(EDGES) - 1))
    variance = float((np.concatenate([offsets for _, offsets in photos]) ** 2).mean())
    for places, offsets in photos:
        distance = cdist(places, places)
        which = np.searchsorted(EDGES, distance.ravel(), side="right") - 1
        inside = (which >= 0) & (which < len(sums))
        products = (offsets @ offsets.T).ravel() / 2
        sums += np.bincount(which[inside], products[inside], minlength=len(sums))
        counts += np.bincount(which[inside], minlength=len(counts))
    if not counts.any():
        return None
    means, middles = sums / np.maximum(counts, 1), (EDGES[1:] + EDGES[:-1]) / 2
    shapes = np.exp(-(middles**2) / (2 * LENGTHS[:, None] ** 2))
    common = (shapes * counts * means).sum(axis=1) / (shapes**2 * counts).sum(axis=1)
    errors = (counts * (means - common[:, None] * shapes) ** 2).sum(axis=1)
    best = int(errors.argmin())
    smooth = float(np.clip(common[best], 0, (1 - LEAST_NOISE) * variance))
    return Covariance(smooth, variance - smooth, float(LENGTHS[best]))


def _points(views: Sequence[View], residuals: Mapping[str, Residuals]) -> list[Points]:
    return [_chosen(residuals.get(view.name, Residuals.none())) for view in views]


def _chosen(residuals: Residuals) -> Points:
    places, offsets = residuals.places.double().numpy(), residuals.offsets.double().numpy()
    if len(places) > MOST_POINTS:
        rows = np.random.default_rng(0).choice(len(places), MOST_POINTS, replace=False)
        places, offsets = places[rows], offsets[rows]
    return places, offsets


def _kriged(
    points: Points, covariance: Covariance, cells: int, width: int, height: int
) -> Float[Tensor, "2 G G"]:
    places, offsets = points
    if not len(places):
        return torch.zeros(2, cells, cells)
    steps = (np.arange(cells) + 0.5) / cells
    x, y = np.meshgrid(steps * width / max(width, height), steps * height / max(width, height))
    among = covariance.at(cdist(places, places, "sqeuclidean")) + covariance.noise * np.eye(len(places))
    to_cells = covariance.at(cdist(np.stack([x.ravel(), y.ravel()], axis=1), places, "sqeuclidean"))
    found = to_cells @ solve(among, offsets, assume_a="pos")
    return torch.from_numpy(found.T.reshape(2, cells, cells)).float()
