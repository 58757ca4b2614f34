"""A run of COLMAP's incremental pipeline, with priors of lenses for collections of up to `PRIORS_LIMIT` photos.

Source: Schönberger and Frahm, "Structure-from-Motion Revisited", CVPR 2016.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from statistics import median
from typing import Any

import pycolmap

from wildgs.sfm.config import SfmConfig
from wildgs.sfm.database import open_database
from wildgs.sfm.lens_priors import (
    ROBUST_SCALE,
    TOLERANCE,
    USUAL_SHIFT,
    WIDE_SHIFT,
    LensPrior,
    adjust_with_priors,
)
from wildgs.sfm.lenses import FOCAL_RANGE, corner_shift
from wildgs.sfm.lookalikes import keeps_agreement
from wildgs.sfm.workplace import Workplace

LEAST_GROUP = 3
"""Smallest number of photos of a model."""

PRIORS_LIMIT = 200
"""Number of photos up to which lenses have priors in bundle adjustment. More photos determine them."""

GROWTH = 1.1
"""Growth of a model after which it is adjusted with priors, as in COLMAP's global bundle adjustment."""

DISTORTION_FROM = 20
"""Number of photos in a model from which usual distortion is estimated while the model grows."""

STRONG_SHIFT = -0.04
"""Median displacement of the photos' corners by distortion from which they are strongly distorted."""

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


def pipeline_options(config: SfmConfig) -> Any:
    """COLMAP's options for all passes."""
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = config.threads
    options.random_seed = config.seed
    options.min_model_size = LEAST_GROUP
    # RANSAC over matches between photos alone took from half a minute to more than eleven for one photo with few
    # correct ones. The second pass, which matches photos to points, places such photos in about a second.
    options.structure_less_registration_fallback = False
    options.ignore_watermarks = True
    options.ba_global_max_refinements = REFINEMENTS
    options.ba_global_function_tolerance = options.ba_local_function_tolerance = TOLERANCE
    options.max_extra_param = MAX_EXTRA_PARAM
    options.min_focal_length_ratio, options.max_focal_length_ratio = FOCAL_RANGE
    return options


def run_pipeline(
    work: Workplace,
    options: Any,
    count: int,
    next_photo: Callable[[], None],
    start: Path | None = None,
    constant: Collection[int] = (),
    *,
    wide: bool,
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
        wide: Whether photos may be distorted like those of action cameras and fisheye lenses.

    Returns:
        The models that have points, largest first.
    """
    manager = pycolmap.ReconstructionManager()
    if start is not None:
        manager.read(start)
    priors = _priors(work) if count <= PRIORS_LIMIT else {}
    options.image_path = work.images
    options.ba_refine_focal_length = options.ba_refine_extra_params = not priors
    with open_database(work.database) as database:
        pipeline = pycolmap.IncrementalPipeline(options, database, manager)
    adjusted: dict[int, int] = {}

    def adjust() -> None:
        number = manager.size() - 1
        model = manager.get(number)
        if priors and model.num_reg_images() >= GROWTH * adjusted.get(number, 0):
            adjust_with_priors(model, priors, corner_shift=_corner_shift(model, wide), constant=constant)
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
            _finish(model, priors, _corner_shift(model, wide), constant)
    return by_size([model for model in models if model.num_points3D()])


def measure_distortion(work: Workplace, model: Any, count: int) -> Any:
    """Estimates the distortion of the lenses of a small finished model, which was mapped without.

    Args:
        work: The workplace.
        model: The model; not modified.
        count: Number of all photos.

    Returns:
        The adjusted model; `model` if there is nothing to estimate or most matches contradict it afterwards.
    """
    if count > PRIORS_LIMIT or _corner_shift(model, is_wide(model)) is not None:
        return model
    adjusted = pycolmap.Reconstruction(model)
    _finish(adjusted, _priors(work), USUAL_SHIFT)
    return adjusted if keeps_agreement(model, adjusted, work.database) else model


def adjust_robustly(
    work: Workplace, model: Any, count: int, constant: Collection[int] = (), *, scale: float = ROBUST_SCALE
) -> None:
    """Adjusts poses, points and lenses of a finished model with a robust loss, and filters its observations.

    Args:
        work: The workplace.
        model: The model; modified.
        count: Number of all photos.
        constant: Ids of cameras whose lenses stay as they are.
        scale: Error from which the loss grows more slowly than the squared one, pixels.
    """
    priors = _priors(work) if count <= PRIORS_LIMIT else {}
    spread = WIDE_SHIFT if is_wide(model) else USUAL_SHIFT
    _finish(model, priors, spread, constant, robust_scale=scale)


def is_wide(model: Any) -> bool:
    """Whether a model was found with strongly distorted photos.

    Strong distortion of lenses moves corners inwards. Usual photos mapped with `WIDE_SHIFT` end with shifts of
    either sign, together with wrong focal lengths, and more of their matches may agree.
    """
    shifts = [corner_shift(model.image(photo).camera) for photo in model.reg_image_ids()]
    return bool(shifts) and median(shifts) <= STRONG_SHIFT


def _corner_shift(model: Any, wide: bool) -> float | None:
    """The prior of distortion for a model of this size."""
    if wide:
        return WIDE_SHIFT
    return USUAL_SHIFT if model.num_reg_images() >= DISTORTION_FROM else None


def _finish(
    model: Any,
    priors: Mapping[int, LensPrior],
    spread: float | None,
    constant: Collection[int] = (),
    *,
    robust_scale: float | None = None,
) -> None:
    adjust_with_priors(
        model, priors, corner_shift=spread, constant=constant, rounds=LAST_ROUNDS, robust_scale=robust_scale
    )
    pycolmap.ObservationManager(model).filter_all_points3D(MAX_ERROR, MIN_ANGLE)


def _priors(work: Workplace) -> dict[int, LensPrior]:
    with open_database(work.database) as database:
        return {camera.camera_id: LensPrior.of(camera) for camera in database.read_all_cameras()}


def by_size(models: Collection[Any]) -> list[Any]:
    """Sorts models by size, largest first."""
    return sorted(models, key=lambda m: (m.num_reg_images(), m.num_points3D()), reverse=True)
