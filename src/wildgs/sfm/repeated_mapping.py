"""Repeated incremental mapping with other seeds and initial pairs, of which the best run is kept."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from itertools import islice
from typing import Any

from wildgs.progress import Progress
from wildgs.sfm.config import SfmConfig
from wildgs.sfm.incremental import is_wide
from wildgs.sfm.initial_pairs import initial_pairs
from wildgs.sfm.lookalikes import count_agreeing
from wildgs.sfm.mapping import missing_from
from wildgs.sfm.mapping_ahead import MappingRun, map_each
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
    attempts = FEW_ATTEMPTS if few else 1 if many else FIRST_ATTEMPTS
    runs = _runs(config.seed, attempts, initial_pairs(work.database, names, config.seed))
    best = _Best(work)
    # Of many photos, one run is enough unless it is stuck, and takes long.
    with closing(map_each(work, len(copies), config, progress, names, runs, ahead=not many)) as mapped:
        for attempt, (run, models) in enumerate(islice(mapped, attempts)):
            best.offer(models, wide=run.wide)
            complete = bool(best.models) and not missing_from(best.models[0], photos)
            if attempt and complete and best.share >= ENOUGH_AGREE:
                return best.models

        stuck, grown, most = _is_stuck(best.models, len(photos)), 0, 1 if many else GROWN_MODELS
        while grown < most and (stuck or (not (few or many) and best.share < ENOUGH_AGREE)):
            _, models = next(mapped, (None, None))
            if models is None:
                break
            best.offer(models, exact=not stuck)
            grown += not _is_stuck(models, len(photos))
    return best.models


def _runs(seed: int, attempts: int, pairs: Iterator[tuple[int, int]]) -> Iterator[MappingRun]:
    """All runs in their order: those of the first attempts, and those with other initial pairs."""
    for attempt in range(attempts):
        wide = attempt % WIDE_EVERY == 1
        pair = None if attempt < FIRST_ATTEMPTS or wide else next(pairs, None)
        yield MappingRun(seed + attempt, wide, pair)
    for pair in islice(pairs, PAIR_ATTEMPTS):
        yield MappingRun(seed, False, pair)


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
