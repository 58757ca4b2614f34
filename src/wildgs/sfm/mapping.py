"""Camera poses by pycolmap's incremental mapping, and continued mapping of photos without a pose.

Source: Schönberger and Frahm, "Structure-from-Motion Revisited", CVPR 2016.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from typing import Any

import pycolmap

from wildgs.progress import Progress
from wildgs.sfm.config import SfmConfig
from wildgs.sfm.lenses import FOCAL_RANGE
from wildgs.sfm.upright import WorkingCopy
from wildgs.sfm.workplace import Workplace

LEAST_GROUP = 3
"""Smallest number of photos of a model."""

FIRST_ATTEMPTS, ATTEMPTS_LIMIT = 3, 200
"""Upper bound on runs of the first pass, and number of photos up to which it is repeated. A poor initial pair,
which depends on the seed, cost up to nine tenths of the photos, and a run is short compared with matching."""

REFINEMENTS = 2
"""Upper bound on repetitions of a global bundle adjustment, which takes most of the time; COLMAP's default is 5."""

MAX_EXTRA_PARAM = 10.0
"""Largest distortion coefficient during mapping. It refers to the squared tangent of the angle from the axis: -1.9
moves the corners of a telephoto lens by only 4%. `wildgs.sfm.lenses` then decides by the corners."""

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
    """Repeats incremental mapping with other seeds while photos are missing; returns the models of the best run.

    The best run is the one whose largest model has the most observations.

    Args:
        work: The workplace.
        copies: All photos.
        config: Options.
        progress: Called for every photo.
        only: The photos to map; empty for all.
    """
    best: list[Any] = []
    names = [copy.work_name for copy in only]
    for attempt in range(FIRST_ATTEMPTS if len(copies) <= ATTEMPTS_LIMIT else 1):
        seeded = replace(config, seed=config.seed + attempt)
        models = map_photos(work, len(copies), seeded, progress, only=names)
        if models and (not best or models[0].compute_num_observations() > best[0].compute_num_observations()):
            best = models
        if best and not missing_from(best[0], only or copies):
            break
    return best


def map_photos(
    work: Workplace, count: int, config: SfmConfig, progress: Progress, only: Sequence[str] = ()
) -> list[Any]:
    """Runs incremental mapping on some working copies or on all; returns all models, largest first."""
    options = _options(config)
    options.image_names = list(only)
    models = pycolmap.incremental_mapping(
        work.database,
        work.images,
        work.fresh("mapping"),
        options,
        next_image_callback=_counted(progress, 2, count),  # a model starts with a pair
    )
    return by_size(models.values())


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
        The larger model, or `model` if no photo could be registered.
    """
    start = work.fresh("start")
    model.write(start)
    options = _options(config)
    options.mapper.abs_pose_min_num_inliers = LATE_INLIERS
    options.mapper.abs_pose_min_inlier_ratio = LATE_INLIER_RATIO
    if constant_lenses:
        lenses = _lenses(work, constant_lenses)
        options.constant_cameras = options.mapper.constant_cameras = lenses
    options.multiple_models = False
    models = pycolmap.incremental_mapping(
        work.database,
        work.images,
        work.fresh("mapping"),
        options,
        input_path=start,
        next_image_callback=_counted(progress, model.num_reg_images(), count),
    )
    largest = by_size(models.values())
    return largest[0] if largest and largest[0].num_reg_images() >= model.num_reg_images() else model


def _lenses(work: Workplace, names: Collection[str]) -> set[int]:
    with closing(pycolmap.Database.open(work.database)) as database:
        return {image.camera_id for image in database.read_all_images() if image.name in names}


def _options(config: SfmConfig) -> Any:
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = config.threads
    options.random_seed = config.seed
    options.min_model_size = LEAST_GROUP
    # RANSAC over matches between photos alone took from half a minute to more than eleven for one photo with few
    # correct ones. The second pass, which matches photos to points, places such photos in about a second.
    options.structure_less_registration_fallback = False
    options.ignore_watermarks = True
    options.ba_global_max_refinements = REFINEMENTS
    options.max_extra_param = MAX_EXTRA_PARAM
    options.min_focal_length_ratio, options.max_focal_length_ratio = FOCAL_RANGE
    return options


def _counted(progress: Progress, start: int, count: int) -> Callable[[], None]:
    done = start

    def count_photo() -> None:
        nonlocal done
        done += 1
        progress("finding poses", min(done, count), count)

    progress("finding poses", 0, count)
    return count_photo


def by_size(models: Collection[Any]) -> list[Any]:
    """Sorts models by size, largest first."""
    return sorted(models, key=lambda m: (m.num_reg_images(), m.num_points3D()), reverse=True)


def find_registered(model: Any, copy: WorkingCopy) -> Any | None:
    """The photo's image in a model; None if it has no pose there."""
    image = model.find_image_with_name(copy.work_name)
    return image if image is not None and image.has_pose else None


def missing_from(model: Any, copies: Sequence[WorkingCopy]) -> list[int]:
    """The photos without a pose in a model."""
    return [row for row, copy in enumerate(copies) if find_registered(model, copy) is None]
