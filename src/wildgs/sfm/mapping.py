"""Camera poses by pycolmap's incremental mapping, and continued mapping of photos without a pose.

Source: Schönberger and Frahm, "Structure-from-Motion Revisited", CVPR 2016.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pycolmap

from wildgs.progress import Progress
from wildgs.sfm.config import SfmConfig
from wildgs.sfm.lens_priors import LensPrior, adjust_with_priors
from wildgs.sfm.lenses import FOCAL_RANGE
from wildgs.sfm.lookalikes import count_agreeing
from wildgs.sfm.upright import WorkingCopy
from wildgs.sfm.workplace import Workplace

LEAST_GROUP = 3
"""Smallest number of photos of a model."""

FIRST_ATTEMPTS, ATTEMPTS_LIMIT = 3, 200
"""Upper bound on runs of the first pass, and number of photos up to which it is repeated. A poor initial pair,
which depends on the seed, cost up to nine tenths of the photos, and a run is short compared with matching."""

FEW, FEW_ATTEMPTS = 30, 10
"""Number of photos up to which the first pass is repeated as often as this while few matches agree with the poses:
runs that register all of few photos differ, and some have wrong depths."""

ENOUGH_AGREE = 0.75
"""Share of the verified matches that is enough. Right models of 16 to 24 photos of `longchamp` have 0.65 to 0.68,
wrong ones 0.55 to 0.6."""

MATCH_WEIGHT = 2
"""Weight of a match that agrees with the poses, relative to an observation of a point."""

PRIORS_LIMIT = 200
"""Number of photos up to which lenses have priors in bundle adjustment. More photos determine them."""

GROWTH = 1.1
"""Growth of a model after which it is adjusted with priors, as in COLMAP's global bundle adjustment."""

DISTORTION_FROM = 20
"""Number of photos in a model from which distortion is estimated while the model grows."""

LAST_ROUNDS = 8
"""Upper bound on rounds of the last adjustment with priors."""

MAX_ERROR, MIN_ANGLE = 4.0, 1.5
"""Largest reprojection error of an observation, pixels, and smallest triangulation angle of a point, degrees, after
it: COLMAP's defaults."""

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

    The best run is the one whose largest model has the highest score. Few photos are always mapped repeatedly.

    Args:
        work: The workplace.
        copies: All photos.
        config: Options.
        progress: Called for every photo.
        only: The photos to map; empty for all.
    """
    best: list[Any] = []
    most, share = -1, 0.0
    names = [copy.work_name for copy in only]
    few = len(only or copies) <= FEW
    attempts = FEW_ATTEMPTS if few else FIRST_ATTEMPTS if len(copies) <= ATTEMPTS_LIMIT else 1
    for attempt in range(attempts):
        seeded = replace(config, seed=config.seed + attempt)
        models = map_photos(work, len(copies), seeded, progress, only=names)
        score, agreeing = _judge(models[0], work) if models else (-1, 0.0)
        if score > most:
            best, most, share = models, score, agreeing
        if best and not missing_from(best[0], only or copies) and (not few or share >= ENOUGH_AGREE):
            break
    return best


def _judge(model: Any, work: Workplace) -> tuple[int, float]:
    """The score of a model, and the share of the verified matches that agree closely with its poses.

    The score is the number of the points' observations and of matches that agree, which count more. Of few photos,
    a model that is too deep or has near and far reversed may have more observations than a right one.
    """
    agreeing, matches = count_agreeing(model, work.database)
    return model.compute_num_observations() + MATCH_WEIGHT * agreeing, agreeing / max(matches, 1)


def map_photos(
    work: Workplace, count: int, config: SfmConfig, progress: Progress, only: Sequence[str] = ()
) -> list[Any]:
    """Runs incremental mapping on some working copies or on all; returns all models, largest first."""
    options = _options(config)
    options.image_names = list(only)
    return _run(work, options, count, _counted(progress, 2, count))  # a model starts with a pair


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
    constant = _lenses(work, constant_lenses)
    options.constant_cameras = options.mapper.constant_cameras = constant
    options.multiple_models = False
    models = _run(work, options, count, _counted(progress, model.num_reg_images(), count), start, constant)
    return models[0] if models and models[0].num_reg_images() >= model.num_reg_images() else model


def _run(
    work: Workplace,
    options: Any,
    count: int,
    next_photo: Callable[[], None],
    start: Path | None = None,
    constant: Collection[int] = (),
) -> list[Any]:
    """Runs COLMAP's incremental pipeline, with priors of lenses for up to `PRIORS_LIMIT` photos.

    With priors, COLMAP adjusts poses and points only, and lenses are adjusted after it, while the model grows.

    Args:
        work: The workplace.
        options: COLMAP's options; modified.
        count: Number of all photos.
        next_photo: Called for each photo after the initial pair.
        start: Folder of a model to continue.
        constant: Ids of cameras whose lenses are constant.

    Returns:
        The models, largest first.
    """
    manager = pycolmap.ReconstructionManager()
    if start is not None:
        manager.read(start)
    priors = _priors(work) if count <= PRIORS_LIMIT else {}
    options.image_path = work.images
    options.ba_refine_focal_length = options.ba_refine_extra_params = not priors
    with closing(pycolmap.Database.open(work.database)) as database:
        pipeline = pycolmap.IncrementalPipeline(options, database, manager)
    adjusted: dict[int, int] = {}

    def adjust() -> None:
        number = manager.size() - 1
        model = manager.get(number)
        if priors and model.num_reg_images() >= GROWTH * adjusted.get(number, 0):
            adjust_with_priors(
                model, priors, distortion=model.num_reg_images() >= DISTORTION_FROM, constant=constant
            )
            adjusted[number] = model.num_reg_images()

    def adjust_after_photo() -> None:
        next_photo()
        adjust()

    moments = pycolmap.IncrementalPipelineCallback
    pipeline.add_callback(moments.INITIAL_IMAGE_PAIR_REG_CALLBACK, adjust)
    pipeline.add_callback(moments.NEXT_IMAGE_REG_CALLBACK, adjust_after_photo)
    pipeline.run()
    models = [pycolmap.Reconstruction(manager.get(number)) for number in range(manager.size())]
    if priors:
        for model in models:
            _finish(model, priors, constant, distortion=model.num_reg_images() >= DISTORTION_FROM)
    return by_size(models)


def measure_distortion(work: Workplace, model: Any, count: int) -> None:
    """Estimates the distortion of the lenses of a small finished model, which was mapped without.

    Args:
        work: The workplace.
        model: The model; modified.
        count: Number of all photos.
    """
    if count <= PRIORS_LIMIT and model.num_reg_images() < DISTORTION_FROM:
        _finish(model, _priors(work), (), distortion=True)


def _finish(
    model: Any, priors: Mapping[int, LensPrior], constant: Collection[int], *, distortion: bool
) -> None:
    adjust_with_priors(model, priors, distortion=distortion, constant=constant, rounds=LAST_ROUNDS)
    pycolmap.ObservationManager(model).filter_all_points3D(MAX_ERROR, MIN_ANGLE)


def _priors(work: Workplace) -> dict[int, LensPrior]:
    with closing(pycolmap.Database.open(work.database)) as database:
        return {camera.camera_id: LensPrior.of(camera) for camera in database.read_all_cameras()}


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
