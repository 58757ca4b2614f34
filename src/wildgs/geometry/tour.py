"""Farthest-point sampling, and a short open tour through points."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from jaxtyping import Float64
from scipy.spatial.distance import cdist


def spread_out(features: Float64[np.ndarray, "V D"], count: int) -> list[int]:
    """Farthest-point sampling: indices of at most `count` rows, each the farthest from those before.

    The first is the row nearest to the median, so that no outlier decides.
    """
    chosen = [int(np.linalg.norm(features - np.median(features, axis=0), axis=1).argmin())]
    distance = np.linalg.norm(features - features[chosen[0]], axis=1)
    while len(chosen) < min(count, len(features)) and distance.max() > 0:
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(features - features[chosen[-1]], axis=1))
    return chosen


def open_tour(places: Float64[np.ndarray, "S D"]) -> list[int]:
    """A short open tour through all places: nearest neighbours from every start, then 2-opt."""
    distance = cdist(places, places)
    tours = [_improve(_nearest_first(start, distance), distance) for start in range(len(places))]
    return min(tours, key=lambda tour: _length(tour, distance))


def _nearest_first(start: int, distance: Float64[np.ndarray, "S S"]) -> list[int]:
    tour, left = [start], set(range(len(distance))) - {start}
    while left:
        tour.append(min(left, key=lambda place: (distance[tour[-1], place], place)))
        left.remove(tour[-1])
    return tour


def _improve(tour: list[int], distance: Float64[np.ndarray, "S S"]) -> list[int]:
    """2-opt: reverses segments as long as that shortens the tour."""
    best = _length(tour, distance)
    improved = True
    while improved:
        improved = False
        for low, high in combinations(range(len(tour) + 1), 2):
            turned = tour[:low] + tour[low:high][::-1] + tour[high:]
            length = _length(turned, distance)
            if length < best - 1e-12:
                tour, best, improved = turned, length, True
    return tour


def _length(tour: list[int], distance: Float64[np.ndarray, "S S"]) -> float:
    return float(distance[tour[:-1], tour[1:]].sum())
