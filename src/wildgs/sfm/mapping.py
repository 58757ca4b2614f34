"""Camera poses by a run of incremental mapping, and continued mapping of photos without a pose."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import pycolmap

from wildgs.progress import Progress
from wildgs.sfm.config import SfmConfig
from wildgs.sfm.database import open_database
from wildgs.sfm.edited_photos import with_square_pixels
from wildgs.sfm.incremental import is_wide, pipeline_options, run_pipeline
from wildgs.sfm.initial_pairs import LEAST_ANGLE, LEAST_MATCHES
from wildgs.sfm.lens_priors import ROBUST_SCALE
from wildgs.sfm.lookalikes import keeps_agreement
from wildgs.sfm.upright import WorkingCopy
from wildgs.sfm.workplace import Workplace

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

    Sets COLMAP's random seed for the calling thread.

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
    # A run depends on its own seed alone, and not on what was mapped before.
    pycolmap.set_random_seed(config.seed)
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
    with open_database(work.database) as database:
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


def names_of(model: Any) -> set[str]:
    """Names of the registered working copies."""
    return {model.image(image_id).name for image_id in model.reg_image_ids()}
