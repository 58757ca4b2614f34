"""The last adjustments of cameras: with more matches, without points of two photos, a robust loss, exact features.

Incremental mapping ends with cameras that are less exact than the photos allow, for five reasons:

- Points of two photos are rarely right. COLMAP makes them of features that further photos matched but do not
  confirm, and nothing but the epipolar line speaks against a wrong match. Here, they do not move cameras.
- Bundle adjustment minimises squared errors, to which a wrong match of 4 pixels contributes as much as 64 right
  ones of half a pixel. Here, its loss is that of Cauchy, under which it contributes as much as 13, as proposed by
  Triggs et al., "Bundle adjustment: a modern synthesis", Vision Algorithms 1999.
- Lowe's test rejects most right matches of repeated architecture. Once cameras are known, photos are matched again
  along epipolar lines (`wildgs.sfm.guided_matching`).
- Features are where a detector finds them, half a pixel from where photos show the same. Once points are known,
  their features are moved there (`wildgs.sfm.keypoint_refinement`), and those that cannot be do not move cameras.
- Photos are cropped and stretched. Their principal points and aspect ratios are fitted last
  (`wildgs.sfm.edited_photos`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection
from typing import Any

import numpy as np
import pycolmap

from wildgs.progress import Counter as Progressed
from wildgs.progress import Progress, counter
from wildgs.sfm.config import CONFIRMED, SfmConfig
from wildgs.sfm.database import open_database
from wildgs.sfm.edited_photos import fit_edited, has_edited
from wildgs.sfm.guided_matching import GuidedMatches, Matches, match_guided, neighbours
from wildgs.sfm.incremental import MAX_ERROR, MIN_ANGLE, adjust_robustly, pipeline_options
from wildgs.sfm.keypoint_refinement import Observation, refine_keypoints
from wildgs.sfm.lens_priors import ROBUST_SCALE
from wildgs.sfm.lookalikes import keeps_agreement, verified_matches
from wildgs.sfm.workplace import Workplace

REACH = 0.003
"""Largest distance of guided matches from the epipolar line, relative to the longer side."""

NEIGHBOURS, LEAST_SHARED = 5, 3
"""Photos with which each one is matched again, those that share most points, and the smallest number of these."""

GUIDED_LIMIT = 1000
"""Number of photos up to which they are matched again, for a few minutes on one core. More photos have more
matches of each point."""

LEAST_CONFIRMED = 20
"""Number of observations of confirmed points below which a photo needs its other points as well."""

MOST_ALIGNED = 0.5
"""Share of a photo's observations from which those that are aligned determine its camera alone."""

TURNS = 3
"""Number of times that cropped photos are fitted and everything is adjusted, in turns."""

EXACT_SCALE = 0.5
"""Error from which the robust loss grows more slowly once features are moved, pixels."""

LEAST_KEPT = 0.9
"""Share of the observations that adjusted cameras have to explain. A scene may become deeper until its points are
too far away to be triangulated."""


def refine(
    work: Workplace,
    model: Any,
    count: int,
    config: SfmConfig,
    progress: Progress,
    guided: GuidedMatches,
    constant: Collection[int] = (),
) -> Any:
    """Matches the photos of a finished model again, moves features, and triangulates and adjusts everything anew.

    Args:
        work: The workplace; its database contains features and verified matches.
        model: The model; not modified.
        count: Number of all photos.
        config: Options.
        progress: Called during matching and moving.
        guided: Guided matches of earlier calls, which are not found again; receives those of this one.
        constant: Ids of cameras whose lenses stay as they are.

    Returns:
        A model with the same photos.
    """
    verified = dict(verified_matches(model.reg_image_ids(), work.database))
    known = triangulate(model, verified, config)
    first = _adjusted(work, known, known, verified, count, config, constant)
    if first is None:
        return known
    show = counter(progress, "matching along epipolar lines")
    matches = with_guided_matches(work, first, verified, guided, show)
    second = _adjusted(work, triangulate(first, matches, config), first, verified, count, config, constant)
    rough = triangulate(first if second is None else second, matches, config)
    show = counter(progress, "aligning features")
    moved, aligned = refine_keypoints(work, rough, show, config.max_image_pixels)
    if not aligned:
        return rough
    _keep_alone(moved, aligned)
    exact = _adjusted(work, moved, rough, matches, count, config, constant, scale=EXACT_SCALE)
    if exact is None:
        return rough
    return _with_edited_photos(work, exact, matches, count, config, constant)


def _with_edited_photos(
    work: Workplace, model: Any, matches: Matches, count: int, config: SfmConfig, constant: Collection[int]
) -> Any:
    """The model with principal points and aspect ratios, fitted in turns with the adjustment of everything else.

    Of very many photos, whose adjustment takes long, once. A model of whole photos stays as it is.
    """
    best = model
    for _ in range(TURNS if model.num_reg_images() <= GUIDED_LIMIT else 1):
        fitted = pycolmap.Reconstruction(best)
        if not fit_edited(fitted, EXACT_SCALE, constant) or not (has_edited(fitted) or has_edited(best)):
            break
        after = _adjusted(work, fitted, best, matches, count, config, constant, scale=EXACT_SCALE)
        if after is None or not keeps_agreement(best, after, work.database):
            break
        best = after
    return best


def _adjusted(
    work: Workplace,
    model: Any,
    before: Any,
    matches: Matches,
    count: int,
    config: SfmConfig,
    constant: Collection[int],
    *,
    scale: float = ROBUST_SCALE,
) -> Any | None:
    """The model with adjusted cameras and new points from matches; None if these are far fewer than before."""
    adjusted = pycolmap.Reconstruction(model)
    for point in unconfirmed(adjusted):
        adjusted.delete_point3D(point)
    adjust_robustly(work, adjusted, count, constant, scale=scale)
    after = triangulate(adjusted, matches, config)
    kept = after.compute_num_observations() >= LEAST_KEPT * before.compute_num_observations()
    return after if kept else None


def with_guided_matches(
    work: Workplace, model: Any, verified: Matches, guided: GuidedMatches, progress: Progressed
) -> Matches:
    """Verified matches, and guided ones of features that have none in the other photo."""
    few = model.num_reg_images() <= GUIDED_LIMIT
    nearest = neighbours(model, NEIGHBOURS, LEAST_SHARED) if few else []
    pairs = [pair for pair in nearest if pair not in guided]
    with open_database(work.database) as database:
        guided.update(match_guided(model, database, pairs, REACH, progress))
    registered = set(model.reg_image_ids())
    found = dict(verified)
    for pair, indices in guided.items():
        if registered.issuperset(pair):
            known = found.get(pair, np.zeros((0, 2), np.uint32))
            new = ~(np.isin(indices[:, 0], known[:, 0]) | np.isin(indices[:, 1], known[:, 1]))
            found[pair] = np.concatenate([known, indices[new]])
    return found


def triangulate(model: Any, matches: Matches, config: SfmConfig) -> Any:
    """A copy of a model with new points from matches; cameras stay as they are.

    Features that match in no third photo become points only where a photo has few others.
    """
    options = pipeline_options(config).get_triangulation()
    copy = pycolmap.Reconstruction(model)
    for point in list(copy.point3D_ids()):
        copy.delete_point3D(point)
    graph = pycolmap.CorrespondenceGraph()
    photos = sorted(copy.reg_image_ids())
    for photo in photos:
        graph.add_image(photo, copy.image(photo).num_points2D())
    for (first, second), indices in matches.items():
        geometry = pycolmap.TwoViewGeometry()
        geometry.inlier_matches = indices
        graph.add_two_view_geometry(first, second, geometry)
    graph.finalize()
    observations = pycolmap.ObservationManager(copy, graph)
    triangulator = pycolmap.IncrementalTriangulator(graph, copy, observations)
    for photo in photos:
        triangulator.triangulate_image(options, photo)
    options.ignore_two_view_tracks = False
    for photo in photos:
        if copy.image(photo).num_points3D < LEAST_CONFIRMED:
            triangulator.triangulate_image(options, photo)
    triangulator.complete_all_tracks(options)
    triangulator.merge_all_tracks(options)
    observations.filter_all_points3D(MAX_ERROR, MIN_ANGLE)
    return copy


def _keep_alone(model: Any, aligned: Collection[Observation]) -> None:
    """Deletes the other observations of points of three photos or more, of photos of which most are aligned."""
    points = {
        point: [(e.image_id, e.point2D_idx) for e in model.point3D(point).track.elements]
        for point in model.point3D_ids()
        if model.point3D(point).track.length() >= CONFIRMED
    }
    total = Counter(photo for elements in points.values() for photo, _ in elements)
    found = Counter(photo for photo, _ in aligned)
    exact = {photo for photo in total if found[photo] >= MOST_ALIGNED * total[photo]}
    for point, elements in points.items():
        others = [element for element in elements if element[0] in exact and element not in aligned]
        if len(elements) - len(others) < 2:
            model.delete_point3D(point)
            continue
        for photo, feature in others:
            model.delete_observation(photo, feature)


def unconfirmed(model: Any) -> list[int]:
    """Ids of the points of two photos, except those of photos that have few others."""
    points = {point: model.point3D(point).track for point in model.point3D_ids()}
    photos = {point: {element.image_id for element in track.elements} for point, track in points.items()}
    confirmed = Counter(
        photo for members in photos.values() if len(members) >= CONFIRMED for photo in members
    )
    return [
        point
        for point, members in photos.items()
        if len(members) < CONFIRMED and min(confirmed[photo] for photo in members) >= LEAST_CONFIRMED
    ]
