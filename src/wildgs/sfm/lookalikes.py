"""Detects photos whose matches contradict their poses, because they show a look-alike or have a wrong pose.

The matches of a pair have a verified epipolar geometry. If it contradicts that of the two poses, the photos show
different places that look alike, or one of the poses is wrong. A photo is doubtful if most of its matches
contradict its pose. The idea of checking pairs against the whole model is due to Zach et al., "Disambiguating
visual relations using loop constraints", CVPR 2010.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from jaxtyping import Bool, Float64, Shaped

from wildgs.sfm.database import open_database

LEAST_MATCHES = 30
"""Smallest number of matches of a pair to be considered; fewer are often wrong by chance."""

VERIFIED = 15
"""Smallest number of matches of a verified pair, COLMAP's default. Many pairs with as few are wrong. They are
considered where a pose rests on little else: more of them contradict it than agree if it is wrong, too."""

MAX_ERROR = 0.01
"""Largest distance from the epipolar line of a match that agrees, relative to the longer side."""

EXACT_ERROR = 0.002
"""The same for matches that count for a model (`count_agreeing`): one pixel of 500."""

LEAST_KEPT = 0.9
"""Smallest share of these that a changed model still has to agree with."""

AGREEING_SHARE = 0.5
"""Smallest fraction of a pair's matches that must agree with the poses."""


@dataclass(frozen=True)
class JudgedPair:
    """A verified pair of registered photos, compared with their poses.

    Attributes:
        photos: Names of the two images.
        matches: Number of verified matches.
        agrees: Whether at least half of them agree with the poses.
    """

    photos: tuple[str, str]
    matches: int
    agrees: bool


def judge_pairs(model: Any, database_file: Path, least: int = LEAST_MATCHES) -> list[JudgedPair]:
    """Compares verified pairs with the poses of a model.

    Args:
        model: pycolmap's reconstruction.
        database_file: Database with the verified matches.
        least: Smallest number of matches of a pair.
    """
    return [
        JudgedPair(
            (first.name, second.name),
            len(matches),
            float(agreeing_matches(first, second, matches, MAX_ERROR).mean()) >= AGREEING_SHARE,
        )
        for first, second, matches in _verified(model, database_file, least)
    ]


def find_doubtful(pairs: Iterable[JudgedPair], names: Mapping[str, str]) -> dict[str, str]:
    """The reasons why poses are doubtful, by photo name.

    Args:
        pairs: The pairs that count (`judge_pairs`).
        names: Names of the photos for messages.
    """
    agreeing: dict[str, int] = {}
    contradicting: dict[str, dict[str, int]] = {}
    for pair in pairs:
        for name, other in (pair.photos, pair.photos[::-1]):
            if pair.agrees:
                agreeing[name] = agreeing.get(name, 0) + pair.matches
            else:
                contradicting.setdefault(name, {})[other] = pair.matches
    return _judge(agreeing, contradicting, names)


def count_agreeing(model: Any, database_file: Path) -> tuple[int, int]:
    """Number of verified matches of registered photos that agree closely with the poses, and of all of them.

    They judge models of the same photos better than their points do: of few photos, a model that is too deep or has
    near and far reversed may have as many points with as small errors, since it leaves out what contradicts it.

    Args:
        model: pycolmap's reconstruction.
        database_file: Database with the verified matches.
    """
    agreeing = [
        agreeing_matches(first, second, matches, EXACT_ERROR)
        for first, second, matches in _verified(model, database_file)
    ]
    return sum(int(mask.sum()) for mask in agreeing), sum(len(mask) for mask in agreeing)


def keeps_agreement(before: Any, after: Any, database_file: Path) -> bool:
    """Whether a changed model still agrees with most of the matches with which it did before.

    Bundle adjustment of a few photos with a few dozen points may end with poses that explain these points and
    contradict most matches.

    Args:
        before: pycolmap's reconstruction.
        after: One with at least the same photos.
        database_file: Database with the verified matches.
    """
    return count_agreeing(after, database_file)[0] >= LEAST_KEPT * count_agreeing(before, database_file)[0]


def verified_matches(
    photos: Collection[int], database_file: Path, least: int = 1
) -> Iterator[tuple[tuple[int, int], Shaped[np.ndarray, "_ 2"]]]:
    """Pairs of some photos that have enough verified matches, and these.

    Args:
        photos: Ids of the images.
        database_file: Database with the verified matches.
        least: Smallest number of matches of a pair.

    Yields:
        The ids of two images, the smaller one first, and indices of their features.
    """
    wanted = set(photos)
    with open_database(database_file) as database:
        for pair_id, inliers in zip(*database.read_two_view_geometry_num_inliers(), strict=True):
            pair = pycolmap.pair_id_to_image_pair(pair_id)
            if inliers >= least and wanted.issuperset(pair):
                yield pair, database.read_two_view_geometry(*pair).inlier_matches


def _verified(
    model: Any, database_file: Path, least: int = LEAST_MATCHES
) -> Iterator[tuple[Any, Any, Shaped[np.ndarray, "M 2"]]]:
    for (first, second), matches in verified_matches(model.reg_image_ids(), database_file, least):
        yield model.image(first), model.image(second), matches


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


def agreeing_matches(
    first: Any, second: Any, matches: Shaped[np.ndarray, "M 2"], max_error: float
) -> Bool[np.ndarray, " M"]:
    """Mask of the matches of two images that agree with the epipolar geometry of their poses in both images.

    Args:
        first: pycolmap's image.
        second: The other one.
        matches: Pairs of their keypoints.
        max_error: Largest distance from the epipolar line, relative to the longer side.
    """
    places = [_places(image, matches[:, side]) for side, image in enumerate((first, second))]
    rays = [unproject(image.camera, points) for image, points in zip((first, second), places, strict=True)]
    essential = essential_matrix(first, second)
    lines = rays[0] @ essential.T, rays[1] @ essential
    residual = np.abs((rays[1] * lines[0]).sum(axis=1))
    fits = np.ones(len(matches), dtype=bool)
    for image, line in zip((second, first), lines, strict=True):
        camera = image.camera
        allowed = max_error * max(camera.width, camera.height) / camera.mean_focal_length()
        fits &= residual <= allowed * np.linalg.norm(line[:, :2], axis=1)
    return fits


def _places(image: Any, features: Shaped[np.ndarray, " M"]) -> Float64[np.ndarray, "M 2"]:
    return np.array([image.point2D(row).xy for row in features.tolist()], dtype=np.float64).reshape(-1, 2)


def essential_matrix(first: Any, second: Any) -> Float64[np.ndarray, "3 3"]:
    """The matrix that maps rays of an image to epipolar lines of another one."""
    relative = second.cam_from_world() * first.cam_from_world().inverse()
    return pycolmap.essential_matrix_from_pose(relative)


def unproject(camera: Any, points: Float64[np.ndarray, "M 2"]) -> Float64[np.ndarray, "M 3"]:
    """Directions of pixels in the camera's frame with z = 1; NaN where strong distortion leaves none."""
    rays = camera.cam_from_img(points)
    return np.concatenate([rays, np.ones((len(points), 1))], axis=1)
