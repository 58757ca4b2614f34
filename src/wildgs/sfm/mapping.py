"""Camera poses by repeated incremental mapping, and continued mapping of photos without a pose."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import Any

import pycolmap

from wildgs.progress import Progress
from wildgs.sfm.config import SfmConfig
from wildgs.sfm.edited_photos import with_square_pixels
from wildgs.sfm.incremental import is_wide, pipeline_options, run_pipeline
from wildgs.sfm.initial_pairs import LEAST_ANGLE, LEAST_MATCHES, initial_pairs
from wildgs.sfm.lens_priors import ROBUST_SCALE
from wildgs.sfm.lookalikes import count_agreeing, keeps_agreement
from wildgs.sfm.upright import WorkingCopy
from wildgs.sfm.workplace import Workplace

FIRST_ATTEMPTS, ATTEMPTS_LIMIT = 3, 200
"""Upper bound on runs of the first pass, and number of photos up to which it is repeated. A poor initial pair,
which depends on the seed, cost up to nine tenths of the photos, and a run is short compared with matching."""

FEW, FEW_ATTEMPTS = 30, 12
"""Number of photos up to which the first pass is repeated as often as this while few matches agree with the poses:
runs that register all of few photos differ, and some have wrong depths."""

ENOUGH_AGREE = 0.75
"""Share of the verified matches that is enough. Right models of 16 to 24 photos of `longchamp` have 0.65 to 0.68,
wrong ones 0.55 to 0.6."""

STUCK_PHOTOS, STUCK_SHARE = 10, 1 / 3
"""A first pass with fewer photos than this, and than this share of all, was stuck with its initial pair. Others are
tried, with as few inliers as in later passes."""

PAIR_ATTEMPTS, GROWN_MODELS = 12, 5
"""Upper bounds on initial pairs tried then, or where too few matches agree with the models of more than `FEW`
photos, and on models with more photos among which the best is chosen. All 58 photos of `longchamp` have a pose in
every model, but those of some are four times as wrong as those of others."""

MATCH_WEIGHT = 6
"""Weight of a match that agrees with the poses, relative to an observation of a point."""

WIDE_EVERY = 3
"""Every run of this many, from the second on, expects strong distortion."""

LATE_INLIERS = 15
"""Smallest number of inliers for registering a photo in later passes; 30 in the first."""
LATE_INLIER_RATIO = 0.1


@contextmanager
def quiet() -> Iterator[None]:
    """Silences COLMAP's log on stderr."""
    previous = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = previous


def map_repeatedly(
    work: Workplace,
    copies: Sequence[WorkingCopy],
    config: SfmConfig,
    progress: Progress,
    only: Sequence[WorkingCopy] = (),
) -> list[Any]:
    """Repeats incremental mapping with other seeds and initial pairs; returns the models of the best run.

    The best run is the one whose largest model has the highest score. Some runs expect strong distortion,
    and count only if they find it.

    Args:
        work: The workplace.
        copies: All photos.
        config: Options.
        progress: Called for every photo.
        only: The photos to map; empty for all.
    """
    names = [copy.work_name for copy in only]
    photos = only or copies
    few, many = len(photos) <= FEW, len(copies) > ATTEMPTS_LIMIT
    pairs = initial_pairs(work.database, names, config.seed)
    best = _Best(work)
    for attempt in range(FEW_ATTEMPTS if few else 1 if many else FIRST_ATTEMPTS):
        seeded = replace(config, seed=config.seed + attempt)
        wide = attempt % WIDE_EVERY == 1
        pair = None if attempt < FIRST_ATTEMPTS or wide else next(pairs, None)
        best.offer(map_photos(work, len(copies), seeded, progress, names, wide=wide, pair=pair), wide=wide)
        complete = bool(best.models) and not missing_from(best.models[0], photos)
        if attempt and complete and best.share >= ENOUGH_AGREE:
            return best.models

    stuck, grown = _is_stuck(best.models, len(photos)), 0
    for pair in islice(pairs, PAIR_ATTEMPTS):
        doubtful = not (few or many) and best.share < ENOUGH_AGREE
        if not (stuck or doubtful) or grown == (1 if many else GROWN_MODELS):
            break
        models = map_photos(work, len(copies), config, progress, names, pair=pair)
        best.offer(models, exact=not stuck)
        grown += not _is_stuck(models, len(photos))
    return best.models


@dataclass
class _Best:
    """The best run so far.

    Attributes:
        work: The workplace.
        models: Its models, largest first.
        score: The score of the largest one.
        share: Share of the verified matches that agree closely with its poses.
    """

    work: Workplace
    models: list[Any] = field(default_factory=list)
    score: int = -1
    share: float = 0.0

    def offer(self, models: list[Any], *, wide: bool = False, exact: bool = False) -> None:
        """Takes a run's models if they are better; with `exact`, only if as large a share of matches agrees."""
        if not models or (wide and not is_wide(models[0])):
            return
        score, share = _judge(models[0], self.work)
        if score > self.score and not (exact and share < self.share):
            self.models, self.score, self.share = models, score, share


def is_better(model: Any, other: Any, work: Workplace) -> bool:
    """Whether a model has a higher score than another one of the same photos."""
    return _judge(model, work)[0] > _judge(other, work)[0]


def _is_stuck(models: Sequence[Any], count: int) -> bool:
    most = models[0].num_reg_images() if models else 0
    return most < min(STUCK_PHOTOS, STUCK_SHARE * count)


def _judge(model: Any, work: Workplace) -> tuple[int, float]:
    """The score of a model, and the share of the verified matches that agree closely with its poses.

    The score is the number of the points' observations and of matches that agree, which count more. Of few photos,
    a model that is too deep or has near and far reversed may have more observations than a right one.
    """
    agreeing, matches = count_agreeing(model, work.database)
    return model.compute_num_observations() + MATCH_WEIGHT * agreeing, agreeing / max(matches, 1)


def map_photos(
    work: Workplace,
    count: int,
    config: SfmConfig,
    progress: Progress,
    only: Sequence[str] = (),
    *,
    wide: bool = False,
    pair: tuple[int, int] | None = None,
) -> list[Any]:
    """Runs incremental mapping on some working copies or on all; returns all models, largest first.

    Args:
        work: The workplace.
        count: Number of all photos.
        config: Options.
        progress: Called for every photo.
        only: Names of the working copies to map; empty for all.
        wide: Whether photos may be distorted like those of action cameras and fisheye lenses.
        pair: Ids of the images to start with. Photos are added with as few inliers as in later passes then, and
            there is one model at most. Default: COLMAP chooses.
    """
    options = pipeline_options(config)
    options.image_names = list(only)
    if pair is not None:
        options.init_image_id1, options.init_image_id2 = pair
        options.mapper.init_min_num_inliers = LEAST_MATCHES
        options.mapper.init_min_tri_angle = LEAST_ANGLE
        options.multiple_models = False  # each of them would start with this pair
        _expect_few_inliers(options)
    next_photo = _counted(progress, 2, count)  # a model starts with a pair
    return run_pipeline(work, options, count, next_photo, wide=wide)


def continue_mapping(
    work: Workplace,
    model: Any,
    count: int,
    config: SfmConfig,
    progress: Progress,
    *,
    constant_lenses: Collection[str] = (),
) -> Any:
    """Registers further photos in a model, with fewer inliers than in the first pass.

    Args:
        work: The workplace.
        model: The model; it is not modified.
        count: Number of all photos, for `progress`.
        config: Options.
        progress: Called for every photo.
        constant_lenses: Working copies whose lenses keep the parameters in the database.

    Returns:
        The larger model, or `model` if no photo could be registered or most matches contradict it afterwards.
    """
    start, square = work.fresh("start"), with_square_pixels(model, ROBUST_SCALE)
    square.write(start)
    options = pipeline_options(config)
    _expect_few_inliers(options)
    constant = lenses_of(work, constant_lenses)
    options.constant_cameras = options.mapper.constant_cameras = constant
    options.multiple_models = False
    next_photo = _counted(progress, model.num_reg_images(), count)
    models = run_pipeline(work, options, count, next_photo, start, constant, wide=is_wide(model))
    grown = bool(models) and models[0].num_reg_images() > model.num_reg_images()
    return models[0] if grown and keeps_agreement(square, models[0], work.database) else model


def _expect_few_inliers(options: Any) -> None:
    options.mapper.abs_pose_min_num_inliers = LATE_INLIERS
    options.mapper.abs_pose_min_inlier_ratio = LATE_INLIER_RATIO


def lenses_of(work: Workplace, names: Collection[str]) -> set[int]:
    """Ids of the cameras of working copies."""
    with closing(pycolmap.Database.open(work.database)) as database:
        return {image.camera_id for image in database.read_all_images() if image.name in names}


def _counted(progress: Progress, start: int, count: int) -> Callable[[], None]:
    done = start

    def count_photo() -> None:
        nonlocal done
        done += 1
        progress("finding poses", min(done, count), count)

    progress("finding poses", 0, count)
    return count_photo


def find_registered(model: Any, copy: WorkingCopy) -> Any | None:
    """The photo's image in a model; None if it has no pose there."""
    image = model.find_image_with_name(copy.work_name)
    return image if image is not None and image.has_pose else None


def missing_from(model: Any, copies: Sequence[WorkingCopy]) -> list[int]:
    """The photos without a pose in a model."""
    return [row for row, copy in enumerate(copies) if find_registered(model, copy) is None]
