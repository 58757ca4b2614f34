"""Multi-view stereo depth of a scene's photos, and its files."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float32
from PIL import Image
from torch import Tensor

from wildgs.errors import WildGSWarning
from wildgs.files import describe_names, written_aside
from wildgs.priors.config import StereoConfig
from wildgs.priors.ground_plane import find_ground
from wildgs.priors.measured_displacements import measured_displacements
from wildgs.priors.stereo.agreement_kernels import count_agreeing, drop_specks
from wildgs.priors.stereo.neighbours import choose_neighbours, seen_rows
from wildgs.priors.stereo.photos import Level, Planes
from wildgs.priors.stereo.search import Search
from wildgs.scene import Scene, load_scene
from wildgs.scene.colmap import read_model
from wildgs.scene.config import DataConfig
from wildgs.scene.photo_store import depth_files, metric_file
from wildgs.scene.undistort import PixelGrid, sample_depth
from wildgs.threads import launch


def stereo_depth(
    scene: Scene, config: StereoConfig, progress: Callable[[int, int], None] | None = None
) -> dict[str, Float32[np.ndarray, "H W"]]:
    """Estimates the depth of the training photos; test photos are not used.

    Photos that are not where their cameras say are displaced first, as far as SfM has measured it.

    Args:
        scene: A scene with photos at matching resolution.
        config: Number of neighbours and thresholds of consistency.
        progress: Called with (photos done, total).

    Returns:
        Photo name to depth along z in the scene's frame, at the view's resolution; 0 where photos do not agree.
    """
    views = scene.train_views
    neighbours = choose_neighbours(scene, config.neighbours)
    measured = measured_displacements(views, scene.residuals)
    fine = Level.of_views(views, measured.grids if measured.grids.any() else None)
    coarse = fine.halved()
    ground = _ground(scene)
    found, refined = coarse.no_planes(), fine.no_planes()
    searches = [
        Search.of(
            view,
            photo,
            others,
            scene.points[torch.from_numpy(seen_rows(scene, view))],
            ground,
            coarse.cameras[photo],
            config.seed,
        )
        for photo, (view, others) in enumerate(zip(views, neighbours, strict=True))
    ]
    for photo, search in enumerate(searches):
        if search is not None:
            search.begin(coarse, found)
        if progress is not None:
            progress(photo, 2 * len(views))
    for photo, search in enumerate(searches):
        if search is not None:
            search.refine(coarse, found, fine, refined)
        if progress is not None:
            progress(len(views) + photo + 1, 2 * len(views))
    return {
        view.name: agreed_depth(fine, photo, others, refined, config)
        for photo, (view, others) in enumerate(zip(views, neighbours, strict=True))
    }


def _ground(scene: Scene) -> Float[Tensor, "3"] | None:
    centers = torch.stack([view.camera.position for view in scene.train_views])
    return find_ground(scene.points, centers)


def agreed_depth(
    level: Level,
    photo: int,
    others: list[int],
    found: Planes,
    config: StereoConfig,
) -> Float32[np.ndarray, "H W"]:
    """Depth of a photo where enough neighbours agree; 0 elsewhere."""
    _, width, height = level.layout[photo]
    if not others:
        return np.zeros((height, width), np.float32)
    inverse, agreeing = np.empty((height, width), np.float32), np.empty((height, width), np.int32)
    launch(
        count_agreeing,
        photo,
        level.layout,
        np.array(others),
        level.motions(photo, others),
        level.returns(photo, others),
        found.planes,
        found.costs,
        np.float32(config.max_cost),
        np.float32(config.tolerance),
        np.float32(config.reach),
        inverse,
        agreeing,
        items=int(height),
    )
    kept = np.empty((height, width), np.bool_)
    specks = (found.of(photo)[0], agreeing >= config.agreeing, np.float32(config.tolerance), config.support)
    launch(drop_specks, *specks, kept, items=int(height))
    return np.where(kept, 1 / np.where(kept, inverse, 1), 0).astype(np.float32)


def fill_metric_folder(
    root: Path,
    config: StereoConfig,
    *,
    holdout: int = DataConfig().holdout,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[int, int]:
    """Writes the metric depth of a scene's training photos, in units of its model (see `metric_file`).

    Held-out photos are not used, so that no test data leaks into training.

    Args:
        root: The scene's folder.
        config: Settings of stereo.
        holdout: Which photos are held out if the scene has no split file, see `DataConfig`.
        overwrite: Replace existing files.
        progress: Called with (photos done, total).

    Returns:
        The number of files written, and the number that already existed.

    Raises:
        UserError: The folder contains no scene.
    """
    data = DataConfig(max_side=config.max_side, holdout=holdout, use_depth=False)
    scene = load_scene(root, data)
    model = read_model(root)
    targets = {
        name: metric_file(path) for name, path in depth_files(root, [i.name for i in model.images]).items()
    }
    wanted = [view.name for view in scene.train_views if overwrite or not targets[view.name].is_file()]
    kept = len(scene.train_views) - len(wanted)
    if not wanted:
        return 0, kept
    depths = stereo_depth(scene, config, progress)
    empty = [name for name in wanted if not depths[name].any()]
    if empty:
        warnings.warn(
            f"{root}: {len(empty)} of {len(wanted)} photos get no depth, since no other photos agree with them: "
            f"{describe_names(empty)}",
            WildGSWarning,
            stacklevel=2,
        )
    cameras = {image.name: image.camera for image in model.images}
    for name in wanted:
        depth = depths[name] / np.float32(scene.alignment.scale)
        grid = PixelGrid.from_colmap(cameras[name], data.downscale, data.max_side).target()
        _write_tiff(depth if grid is None else sample_depth(depth, grid), targets[name])
    return len(wanted), kept


def _write_tiff(depth: Float32[np.ndarray, "H W"], target: Path) -> None:
    with written_aside(target) as aside:
        Image.fromarray(depth).save(aside, "TIFF", compression="tiff_deflate")
