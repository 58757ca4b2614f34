"""View selection for stereo: the neighbours against which each photo is matched."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Int

from wildgs.scene import Scene, View
from wildgs.scene.scene import observed_rows

_LEAST_SHARED = 3
_BEST_ANGLE, _NARROWER, _WIDER = 10.0, 4.0, 12.0  # degrees; wide enough to tell depth, narrow enough to match
_MOST_POINTS = 2000


def choose_neighbours(scene: Scene, most: int) -> list[list[int]]:
    """Selects, for every training photo, the training photos with the most shared points at good angles.

    Triangulation angles of about ten degrees determine depth well, while the photos still look alike.

    Args:
        scene: A scene with observations; without them, a photo observes all points that project into it.
        most: Maximum number of neighbours.
    """
    views = scene.train_views
    seen = [seen_rows(scene, view) for view in views]
    rows = np.concatenate([np.full(len(points), index) for index, points in enumerate(seen)])
    columns = np.concatenate(seen)
    centers = torch.stack([view.camera.position for view in views]).double().numpy()
    places = scene.points.double().numpy()
    order = np.argsort(columns, kind="stable")
    rows, columns = rows[order], columns[order]
    starts = np.searchsorted(columns, np.arange(len(places) + 1))
    neighbours = []
    for index, points in enumerate(seen):
        mine = points[:: -(-len(points) // _MOST_POINTS)] if len(points) else points
        counts = starts[mine + 1] - starts[mine]
        which = np.repeat(np.arange(len(mine)), counts)
        within = np.arange(len(which)) - np.repeat(counts.cumsum() - counts, counts)
        other = rows[starts[mine][which] + within]
        here, there = (centers[index] - places[mine])[which], centers[other] - places[mine][which]
        near, far = np.linalg.norm(here, axis=1), np.linalg.norm(there, axis=1)
        cosine = (here * there).sum(axis=1) / np.maximum(near * far, 1e-12)
        angle = np.degrees(np.arccos(cosine.clip(-1, 1)))
        width = np.where(angle < _BEST_ANGLE, _NARROWER, _WIDER)
        focal = np.array([float(view.camera.K[0, 0]) for view in views])
        ratio = (focal[index] / near) / (focal[other] / far)
        weight = np.exp(-(((angle - _BEST_ANGLE) / width) ** 2) / 2) * np.minimum(ratio, 1 / ratio)
        shared = np.bincount(other, minlength=len(views))
        score = np.bincount(other, weight, minlength=len(views))
        score[index] = 0
        score[shared < _LEAST_SHARED] = 0
        best = np.argsort(-score, kind="stable")[:most]
        neighbours.append([int(view) for view in best if score[view] > 0])
    return neighbours


def seen_rows(scene: Scene, view: View) -> Int[np.ndarray, " K"]:
    """Rows of the points that a photo observes; without observations, of all points that project into it."""
    observed = observed_rows(scene, view)
    if len(observed) >= _LEAST_SHARED:
        return observed.numpy()
    pixels, z = view.camera.project(scene.points)
    size = torch.tensor([view.camera.width, view.camera.height])
    return ((z > 0) & ((pixels >= 0) & (pixels < size)).all(dim=1)).nonzero()[:, 0].numpy()
