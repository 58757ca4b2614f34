"""`load_scene`: reads a scene folder as views with cameras in the aligned frame."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch

from wildgs.errors import UserError, WildGSWarning
from wildgs.files import describe_names
from wildgs.geometry.camera import Camera
from wildgs.progress import Counter, in_threads
from wildgs.scene.alignment import align_world
from wildgs.scene.colmap import ColmapImage, ColmapModel, read_model
from wildgs.scene.config import DECODERS, IMAGE_CACHE, DataConfig, parse_bytes
from wildgs.scene.image_cache import ImageCache, available_memory
from wildgs.scene.images import UnreadableImageError
from wildgs.scene.photo_store import ScenePhotos
from wildgs.scene.residuals import Residuals, residuals_of
from wildgs.scene.scene import Alignment, Scene, Split, View, observations_of
from wildgs.scene.split import assign_splits
from wildgs.scene.undistort import PixelGrid

CACHE_SHARE = 0.5
"""Largest fraction of the free memory for decoded photos, whatever the configured limit."""


def load_scene(
    root: Path,
    config: DataConfig | None = None,
    *,
    alignment: Alignment | None = None,
    lazy: bool = False,
    image_cache: str = IMAGE_CACHE,
    progress: Counter | None = None,
) -> Scene:
    """Reads a COLMAP scene: cameras, points, split, photos, masks and depth maps.

    Every photo is decoded once, so that unreadable ones are found before training.

    Args:
        root: Folder with `images/` and `sparse/0/` (or `sparse/`, `dense/sparse/`), optionally a `*.tsv`
            split, `masks/`, `depth/` and `truth/`.
        config: Size, split and limits; None for the defaults.
        alignment: Transform from the model's frame to the aligned frame; None computes it from the model. For a
            run, its own alignment, to which its Gaussians belong.
        lazy: Decode photos on demand and keep only the last few. Views of unreadable photos are then not left out.
        image_cache: Memory for decoded photos, such as 4GB.
        progress: Called with (photos read, total number of photos).

    Returns:
        The scene in the aligned frame (+z up, median depth of the photos = 1).

    Raises:
        UserError: There is no model, no point, no readable photo or no training photo, or a file has a wrong aspect
            ratio.
    """
    root, config = Path(root), config or DataConfig()
    model = read_model(root)
    names = [image.name for image in model.images]
    splits = assign_splits(names, root, config.holdout)
    if alignment is None:
        alignment = align_world(
            [_unit_camera(image) for image in model.images],
            model.points,
            [image.median_depth for image in model.images if image.median_depth is not None],
        )
    photos = ScenePhotos(
        root,
        model.images_dir,
        names,
        ImageCache(0 if lazy else _cache_limit(image_cache)),
        use_masks=config.use_masks,
        use_depth=config.use_depth,
        use_metric_depth=config.use_metric_depth,
        max_pixels=config.max_image_pixels,
        depth_scale=alignment.scale,
    )
    chosen = [image for image in model.images if image.name in splits]
    views, broken = _load_views(chosen, splits, photos, alignment, config, lazy, progress)
    _report_broken(broken, views, model.images_dir)
    _report_unused(photos)
    _report_blank(views, photos)
    scene = Scene(
        root=root,
        views=tuple(views),
        points=alignment.apply_points(model.points).to(torch.float32),
        point_colors=model.point_colors,
        alignment=alignment,
        observations=observations_of(model.observations, names, views),
        residuals={} if lazy else _residuals(model, views, config),
    )
    if photos.use_metric_depth and not lazy:
        refuse_other_units(scene)
    return scene


def _residuals(model: ColmapModel, views: Sequence[View], config: DataConfig) -> dict[str, Residuals]:
    images = {image.name: image for image in model.images}
    return {
        view.name: residuals_of(images[view.name], model.points, _pixel_grid(images[view.name], config))
        for view in views
        if view.split == "train"
    }


def _report_unused(photos: ScenePhotos) -> None:
    """Warns of masks and depth maps whose names match no photo."""
    for folder, used in (("masks", photos.use_masks), ("depth", photos.use_depth)):
        if used and (names := photos.unused(folder)):
            warnings.warn(
                f"{photos.root / folder}: {len(names)} files match no photo by name and are not used: "
                f"{describe_names(names)}; that of a.jpg is a.jpg.png, or a.png if no other photo has its stem",
                WildGSWarning,
                stacklevel=3,
            )


def _report_blank(views: Sequence[View], photos: ScenePhotos) -> None:
    """Warns of training photos that are masked completely, for example by an inverted mask."""
    blank = [view.name for view in views if view.split == "train" and view.name in photos.blank]
    if blank:
        warnings.warn(
            f"{len(blank)} training photos are masked completely and have no effect: "
            f"{describe_names(blank)}; in masks, 0 = ignore the pixel",
            WildGSWarning,
            stacklevel=3,
        )


def _unit_camera(image: ColmapImage) -> Camera:
    """A camera with the photo's pose, for the alignment."""
    return Camera(viewmat=image.viewmat, K=torch.eye(3, dtype=torch.float64), width=1, height=1)


def _load_views(
    chosen: Sequence[ColmapImage],
    splits: dict[str, Split],
    photos: ScenePhotos,
    alignment: Alignment,
    config: DataConfig,
    lazy: bool,
    progress: Counter | None,
) -> tuple[list[View], list[tuple[str, str]]]:
    """Views sorted by name, and (name, reason) of the photos that cannot be read."""
    views: list[View] = []
    broken: list[tuple[str, str]] = []

    def load(image: ColmapImage) -> View | str:
        try:
            grid = _pixel_grid(image, config)
            photos.add(image.name, grid)
            if not lazy:
                photos.load(image.name, keep=splits[image.name] == "train")
        except UnreadableImageError as error:
            return str(error)
        camera = alignment.apply_camera(Camera(image.viewmat, grid.K, grid.width, grid.height))
        camera = replace(camera, viewmat=camera.viewmat.float(), K=camera.K.float())
        return View(image.name, camera, splits[image.name], photos)

    for image, view in zip(chosen, in_threads(load, chosen, DECODERS, progress), strict=True):
        if isinstance(view, str):
            broken.append((image.name, view))
        else:
            views.append(view)
    return views, broken


def _cache_limit(image_cache: str) -> int:
    limit, available = parse_bytes(image_cache), available_memory()
    return limit if available is None else min(limit, int(CACHE_SHARE * available))


def _pixel_grid(image: ColmapImage, config: DataConfig) -> PixelGrid:
    """The mapping from the stored photo's pixels to those of the view."""
    if image.camera.is_spherical():
        raise UserError(f"{image.name}: spherical cameras ({image.camera.model_name}) are not supported")
    size = (image.camera.width, image.camera.height)
    if size[0] * size[1] > config.max_image_pixels:
        raise UnreadableImageError(
            f"its camera has {size[0]}x{size[1]} pixels, more than --max-image-pixels {config.max_image_pixels}"
        )
    grid = PixelGrid.from_colmap(image.camera, config.downscale, config.max_side)
    if min(grid.width, grid.height) < 2:
        raise UnreadableImageError(
            f"{grid.width}x{grid.height} pixels are too few; lower --downscale or raise --max-side"
        )
    return grid


def _report_broken(broken: Sequence[tuple[str, str]], views: Sequence[View], images_dir: Path) -> None:
    """Warns of unreadable photos; raises `UserError` if no training photo is left."""
    described = describe_names([f"{name} ({reason})" for name, reason in broken])
    if not any(view.split == "train" for view in views):
        raise UserError(f"{images_dir}: no training photo can be read: {described}")
    if broken:
        warnings.warn(
            f"{len(broken)} photos in {images_dir} cannot be read and are left out: {described}",
            WildGSWarning,
            stacklevel=3,
        )


_COMPARED_PHOTOS, _LEAST_POINTS = 20, 10
_MOST_RATIO = 1.25
"""Largest median ratio between metric depth and the depth of the model's points."""


def refuse_other_units(scene: Scene) -> None:
    """Compares metric depth with the depth of the points that photos observe.

    Raises:
        UserError: The depth maps were made for another model, or have other units.
    """
    if next((scene.root / "depth").rglob("*.tiff"), None) is None:
        return
    train = [(row, view) for row, view in enumerate(scene.views) if view.split == "train"]
    chosen = train[:: max(1, len(train) // _COMPARED_PHOTOS)]
    ratios = [ratio for row, view in chosen if (ratio := _ratio(scene, row, view)) is not None]
    if not ratios:
        return
    usual = float(torch.tensor(ratios).median())
    if not 1 / _MOST_RATIO <= usual <= _MOST_RATIO:
        raise UserError(
            f"{scene.root / 'depth'}: metric depth (.tiff) is {usual:.3g} times the depth of the model's points; "
            f"it has other units or belongs to another model: divide it by {usual:.3g}, or delete these files and "
            "run `wildgs depth --by stereo`"
        )


def _ratio(scene: Scene, row: int, view: View) -> float | None:
    """Median ratio of metric depth to the depth of points; None if too few points have both."""
    depth = view.read_depth()
    if depth is None:
        return None
    observed = scene.observations[:, 0] == row
    pixels, z = view.camera.project(scene.points[scene.observations[observed, 1].long()])
    size = torch.tensor([view.camera.width, view.camera.height])
    inside = (z > 0) & ((pixels >= 0) & (pixels < size)).all(dim=1)
    x, y = pixels[inside].long().unbind(dim=1)
    found, z = depth[y, x], z[inside]
    valid = found > 0
    return float((found[valid] / z[valid]).median()) if int(valid.sum()) >= _LEAST_POINTS else None
