"""The passes of structure from motion; the second and third register photos that the first one leaves out.

The model is refined after them (`wildgs.sfm.refinement`).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import pycolmap
from jaxtyping import Float
from torch import Tensor

from wildgs.progress import Progress, counter
from wildgs.sfm.config import SfmConfig
from wildgs.sfm.enlarged import enlarge_small
from wildgs.sfm.guided_matching import GuidedMatches
from wildgs.sfm.incremental import LEAST_GROUP, by_size, measure_distortion
from wildgs.sfm.lenses import drop_impossible
from wildgs.sfm.lookalikes import find_doubtful
from wildgs.sfm.mapping import (
    continue_mapping,
    lenses_of,
    map_photos,
    map_repeatedly,
    missing_from,
)
from wildgs.sfm.matching import describe_photos, extract, forget_pairs, match, match_pairs, verified_pairs
from wildgs.sfm.pairs import Pair, Pairing, alike_pairs, friends_of_friends
from wildgs.sfm.placement import Findings, PassName, count_neighbours, find_groups
from wildgs.sfm.point_matching import match_to_points
from wildgs.sfm.refinement import refine
from wildgs.sfm.upright import WorkingCopy
from wildgs.sfm.workplace import Workplace

ENOUGH_MATCHES = 60
"""Number of matches from which a pair is not matched again."""

POINT_ROUNDS = 5
"""Upper bound on rounds of matching to points; newly registered photos add points for others."""

LEAST_POINTS = 10
"""Smallest number of sparse points of a photo registered by a later pass."""


@dataclass(frozen=True)
class Poses:
    """Result of all passes.

    Attributes:
        models: All models; the first one is kept.
        pairing: The matched pairs.
        passes: The pass that registered a photo, if not the first, by name of its working copy.
        findings: Further findings about photos.
    """

    models: list[Any]
    pairing: Pairing
    passes: dict[str, PassName]
    findings: Findings


def find_poses(
    work: Workplace, copies: Sequence[WorkingCopy], config: SfmConfig, progress: Progress
) -> Poses | None:
    """Computes features, matches and poses of the working copies; None if no photos match.

    Features, matches and models of the first pass of an interrupted call are reused from the workplace.
    """
    extract(work, copies, config, progress)
    progress("choosing pairs", 0, 0)
    vlads = describe_photos(work, copies, config.seed)
    pairing, crops = match(work, copies, vlads, config, progress)
    models = work.load_models("first")
    if models is None:
        models = map_repeatedly(work, copies, config, progress)
        work.save_models("first", models)
    passes: dict[str, PassName] = {}
    if config.second_chance:
        if models:
            drop_impossible(models[0])  # the next passes try these photos again
            if not work.is_done("enlarged"):
                missing = set(missing_from(models[0], copies)) - set(crops)
                enlarge_small(work, copies, missing, config.max_features)
                work.set_done("enlarged")
        models, more = _try_again(work, copies, vlads, models, crops, passes, config, progress)
        pairing = Pairing(pairing.name, tuple(sorted({*pairing.pairs, *more})))
    if not models:
        return None
    measure_distortion(work, models[0], len(copies))
    guided: GuidedMatches = {}
    models[0] = _refine(work, copies, vlads, models[0], guided, passes, config, progress)
    lenses = drop_impossible(models[0])
    if lenses and config.second_chance:
        models[0] = place_with_plain_lens(
            work, copies, vlads, models[0], set(lenses), guided, passes, config, progress
        )
        lenses |= drop_impossible(models[0])
        lenses = {name: why for name, why in lenses.items() if name not in _names(models[0])}
    return Poses(models, pairing, passes, Findings(crops, lenses))


def _refine(
    work: Workplace,
    copies: Sequence[WorkingCopy],
    vlads: Float[Tensor, "N D"],
    model: Any,
    guided: GuidedMatches,
    passes: dict[str, PassName],
    config: SfmConfig,
    progress: Progress,
) -> Any:
    """The refined model, with photos that only its points, of which there are more, give a pose."""
    again = counter(progress, "matching along epipolar lines")
    refined = refine(work, model, len(copies), config, again, guided)
    if not config.second_chance or not missing_from(refined, copies):
        return refined
    grown = _place_by_points(work, copies, vlads, [refined], passes, "second", config, progress)[0]
    drop_unsure(grown, work, passes)
    if not _names(grown) - _names(refined):
        return refined
    return refine(work, grown, len(copies), config, again, guided)


def _try_again(
    work: Workplace,
    copies: Sequence[WorkingCopy],
    vlads: Float[Tensor, "N D"],
    models: list[Any],
    crops: Mapping[int, int],
    passes: dict[str, PassName],
    config: SfmConfig,
    progress: Progress,
) -> tuple[list[Any], set[Pair]]:
    """Runs the second and third pass.

    Returns:
        All models, and the pairs that were matched again; registered photos are added to `passes`.
    """
    if models:
        models = _place_by_points(work, copies, vlads, models, passes, "second", config, progress)
        if not missing_from(models[0], copies):
            return models[:1], set()
    more = _more_pairs(work, copies, vlads, models, crops, config)
    if not work.is_done("more matches"):
        forget_pairs(work, copies, more)
        match_pairs(work, copies, more, config, counter(progress, "matching again"), tolerant=True)
        work.set_done("more matches")
    if not models:
        return map_photos(work, len(copies), config, progress), more
    main = _third_pass(work, copies, vlads, models[0], passes, config, progress)
    own: dict[str, PassName] = {}
    models = by_size([main, *map_rest(work, copies, vlads, main, own, config, progress)])
    if models[0] is not main:
        passes.clear()
        passes.update(own)
    return models, more


def _third_pass(
    work: Workplace,
    copies: Sequence[WorkingCopy],
    vlads: Float[Tensor, "N D"],
    model: Any,
    passes: dict[str, PassName],
    config: SfmConfig,
    progress: Progress,
) -> Any:
    """Registers further photos with fewer inliers, matches others to the points again, and drops unsure ones."""
    grown = continue_mapping(work, model, len(copies), config, progress)
    _note_new(model, grown, passes, "third")
    main = _place_by_points(work, copies, vlads, [grown], passes, "third", config, progress)[0]
    drop_unsure(main, work, passes)
    return main


def map_rest(
    work: Workplace,
    copies: Sequence[WorkingCopy],
    vlads: Float[Tensor, "N D"],
    main: Any,
    passes: dict[str, PassName],
    config: SfmConfig,
    progress: Progress,
) -> list[Any]:
    """Models of the photos that the main model leaves out.

    If more of them belong together than the main model has, that is a model of another place which happened to be
    found first. They are mapped alone, with several seeds, and with the second and third pass of their own, which
    are noted in `passes`.
    """
    rest = missing_from(main, copies)
    if len(rest) < LEAST_GROUP:
        return []
    with closing(pycolmap.Database.open(work.database)) as database:
        groups = find_groups(rest, verified_pairs(database, copies))
    largest = max(groups.values(), key=len)
    if len(largest) > main.num_reg_images():
        models = map_repeatedly(work, copies, config, progress, [copies[row] for row in sorted(largest)])
        if models:
            models = _place_by_points(work, copies, vlads, models, passes, "second", config, progress)
            models[0] = _third_pass(work, copies, vlads, models[0], passes, config, progress)
        return models
    return map_photos(work, len(copies), config, progress, [copies[row].work_name for row in rest])


def _place_by_points(
    work: Workplace,
    copies: Sequence[WorkingCopy],
    vlads: Float[Tensor, "N D"],
    models: list[Any],
    passes: dict[str, PassName],
    name: PassName,
    config: SfmConfig,
    progress: Progress,
) -> list[Any]:
    """Registers further photos in the first model by matching them to its points, repeatedly."""
    main = models[0]
    show = counter(progress, "matching to points")
    for _ in range(POINT_ROUNDS):
        if not match_to_points(work, copies, vlads, main, config.seed, show):
            break
        before, main = main, continue_mapping(work, main, len(copies), config, progress)
        _note_new(before, main, passes, name)
        if main.num_reg_images() == before.num_reg_images():
            break
    return [main, *models[1:]]


def place_with_plain_lens(
    work: Workplace,
    copies: Sequence[WorkingCopy],
    vlads: Float[Tensor, "N D"],
    model: Any,
    names: Collection[str],
    guided: GuidedMatches,
    passes: dict[str, PassName],
    config: SfmConfig,
    progress: Progress,
) -> Any:
    """Registers photos whose lens had become implausible with the focal length of their matches to points.

    Their lenses have no distortion and stay as they are, because bundle adjustment made them implausible.

    Args:
        work: The workplace.
        copies: All photos.
        vlads: VLAD descriptors of all photos.
        model: The model, without these photos.
        names: Names of their working copies.
        guided: Guided matches of other photos; receives theirs.
        passes: Receives the pass of those registered.
        config: Options.
        progress: Called during matching and mapping.

    Returns:
        The model, with those of the photos for which a pose was found.
    """
    show = counter(progress, "matching to points")
    if not match_to_points(work, copies, vlads, model, config.seed, show, only=names):
        return model
    after = continue_mapping(work, model, len(copies), config, progress, constant_lenses=names)
    _note_new(model, after, passes, "second")
    drop_unsure(after, work, passes)
    again = counter(progress, "matching along epipolar lines")
    return refine(work, after, len(copies), config, again, guided, lenses_of(work, names))


def _more_pairs(
    work: Workplace,
    copies: Sequence[WorkingCopy],
    vlads: Float[Tensor, "N D"],
    models: Sequence[Any],
    crops: Mapping[int, int],
    config: SfmConfig,
) -> set[Pair]:
    """Further pairs for photos without a pose, by retrieval and shared matches, without those that match well."""
    kept = [photo for photo in range(len(copies)) if photo not in crops]
    missing = set(missing_from(models[0], copies)) if models else set(kept)
    with closing(pycolmap.Database.open(work.database)) as database:
        matched = verified_pairs(database, copies)
    count = config.pairing.neighbours
    wanted = {row: count for row, photo in enumerate(kept) if photo in missing}
    alike = {(kept[a], kept[b]) for a, b in alike_pairs(vlads[kept], wanted)}
    friends = friends_of_friends(missing - set(crops), matched, count)
    return {
        pair
        for pair in alike | friends
        if not set(pair) & set(crops) and matched.get(pair, 0) < ENOUGH_MATCHES
    }


def _names(model: Any) -> set[str]:
    return {model.image(image_id).name for image_id in model.reg_image_ids()}


def _note_new(before: Any, after: Any, passes: dict[str, PassName], name: PassName) -> None:
    for new in _names(after) - _names(before):
        passes.setdefault(new, name)


def drop_unsure(model: Any, work: Workplace, passes: Mapping[str, PassName]) -> None:
    """Removes photos registered by a later pass whose poses are not reliable.

    They have too few points, are contradicted by most of their matches, or share few points with every other photo.
    Repeated architecture, like the sides of an octagonal tower, gives points scattered over many photos.
    """
    doubtful = find_doubtful(model, work.database, {name: name for name in _names(model)})
    for image_id in list(model.reg_image_ids()):
        image = model.image(image_id)
        if image.name not in passes:
            continue
        if image.name in doubtful or image.num_points3D < LEAST_POINTS or not count_neighbours(model, image):
            model.deregister_frame(image.frame_id)
