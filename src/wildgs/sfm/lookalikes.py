"""Detects photos whose matches contradict their poses, because they show a look-alike or have a wrong pose.

The matches of a pair have a verified epipolar geometry. If it contradicts that of the two poses, the photos show
different places that look alike, or one of the poses is wrong. A photo is doubtful if most of its matches
contradict its pose. The idea of checking pairs against the whole model is due to Zach et al., "Disambiguating
visual relations using loop constraints", CVPR 2010.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from jaxtyping import Float64, Shaped

LEAST_MATCHES = 30
"""Smallest number of matches of a pair to be considered; fewer are often wrong by chance."""

MAX_ERROR = 0.01
"""Largest distance from the epipolar line of a match that agrees, relative to the longer side."""

AGREEING_SHARE = 0.5
"""Smallest fraction of a pair's matches that must agree with the poses."""


def find_doubtful(model: Any, database_file: Path, names: Mapping[str, str]) -> dict[str, str]:
    """The reasons why poses are doubtful, by photo name.

    Args:
        model: pycolmap's reconstruction.
        database_file: Database with the verified matches.
        names: Names of the photos for messages.
    """
    agreeing: dict[str, int] = {}
    contradicting: dict[str, dict[str, int]] = {}
    registered = set(model.reg_image_ids())
    with closing(pycolmap.Database.open(database_file)) as database:
        for pair_id, inliers in zip(*database.read_two_view_geometry_num_inliers(), strict=True):
            first, second = pycolmap.pair_id_to_image_pair(pair_id)
            if inliers < LEAST_MATCHES or first not in registered or second not in registered:
                continue
            matches = database.read_two_view_geometry(first, second).inlier_matches
            share = agreeing_share(model.image(first), model.image(second), matches)
            pair = model.image(first).name, model.image(second).name
            for name, other in (pair, pair[::-1]):
                if share >= AGREEING_SHARE:
                    agreeing[name] = agreeing.get(name, 0) + int(inliers)
                else:
                    contradicting.setdefault(name, {})[other] = int(inliers)
    return _judge(agreeing, contradicting, names)


def _judge(
    agreeing: Mapping[str, int], contradicting: Mapping[str, Mapping[str, int]], names: Mapping[str, str]
) -> dict[str, str]:
    doubtful = {}
    for name, others in contradicting.items():
        against, supported = sum(others.values()), agreeing.get(name, 0)
        if against > supported:
            strongest = max(others, key=lambda other: others[other])
            doubtful[name] = (
                f"{against} of its {against + supported} matches contradict its pose, most of them with"
                f" {names[strongest]}"
            )
    return doubtful


def agreeing_share(first: Any, second: Any, matches: Shaped[np.ndarray, "M 2"]) -> float:
    """Fraction of the matches of two images that agree with the epipolar geometry of their poses in both images."""
    places = [_keypoints(image)[matches[:, side]] for side, image in enumerate((first, second))]
    rays = [_unproject(image.camera, points) for image, points in zip((first, second), places, strict=True)]
    relative = second.cam_from_world() * first.cam_from_world().inverse()
    essential = pycolmap.essential_matrix_from_pose(relative)
    lines = rays[0] @ essential.T, rays[1] @ essential
    residual = np.abs((rays[1] * lines[0]).sum(axis=1))
    fits = np.ones(len(matches), dtype=bool)
    for image, line in zip((second, first), lines, strict=True):
        camera = image.camera
        allowed = MAX_ERROR * max(camera.width, camera.height) / camera.mean_focal_length()
        fits &= residual <= allowed * np.linalg.norm(line[:, :2], axis=1)
    return float(fits.mean())


def _keypoints(image: Any) -> Float64[np.ndarray, "N 2"]:
    return np.array([point.xy for point in image.points2D], dtype=np.float64).reshape(-1, 2)


def _unproject(camera: Any, points: Float64[np.ndarray, "M 2"]) -> Float64[np.ndarray, "M 3"]:
    rays = camera.cam_from_img(points)
    return np.concatenate([rays, np.ones((len(points), 1))], axis=1)
