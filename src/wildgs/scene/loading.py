"""`load_scene`: a scene folder becomes views with cameras in the aligned frame."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path

import torch

from wildgs.errors import UserError, WildGSWarning
from wildgs.geometry.camera import Camera
from wildgs.scene.alignment import align_world
from wildgs.scene.colmap import ColmapImage, describe_names, read_model
from wildgs.scene.config import DataConfig, parse_bytes
from wildgs.scene.image_cache import DECODERS, CachedPictures, ImageCache, available_memory
from wildgs.scene.images import UnreadableImageError
from wildgs.scene.pictures import PhotoFiles, Pictures
from wildgs.scene.scene import Alignment, Scene, Split, View
from wildgs.scene.split import assign_splits
from wildgs.scene.undistort import PixelGrid

CACHE_SHARE = 0.5
"""Share of the free memory that decoded photos take at most, whatever the limit."""

KEPT_PICTURES = 8
"""Photos that a lazily read scene keeps decoded."""


def load_scene(
    root: Path,
    config: DataConfig | None = None,
    *,
    lazy: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Scene:
    """Read a COLMAP scene: cameras, points, split, photos (8 bits, within `image_cache`), masks, depth.

    Every photo is decoded once, so that broken ones are known before training begins.

    Args:
        root: Folder with `images/` and `sparse/0/` (or `sparse/`, `dense/sparse/`), optionally a `*.tsv`
            split, `masks/`, `depth/` and `truth/`.
        config: Size, split and limits; the defaults where None.
        lazy: Decode photos only when they are asked for, and keep the last few: for tools that look at some of
            them. A photo that cannot be read is then no reason to leave its view out.
        progress: Called with (photos read, photos in all) as photos are decoded.

    Returns:
        The scene in its aligned frame (+z up, median depth 1).

    Raises:
        UserError: There is no model, point, readable photo or photo to train on, or a file has the wrong
            shape.
    """
    root, config = Path(root), config or DataConfig()
    model = read_model(root)
    splits = assign_splits([image.name for image in model.images], root, config.holdout)
    alignment = align_world(
        [_unit_camera(image) for image in model.images],
        model.points,
        [image.median_depth for image in model.images if image.median_depth is not None],
    )
    chosen = [image for image in model.images if image.name in splits]
    load_view = partial(
        _lazy_view if lazy else partial(_load_view, cache=ImageCache(_cache_limit(config))),
        alignment=alignment,
        images_dir=model.images_dir,
        root=root,
        config=config,
    )
    views, broken = _load_views(chosen, splits, load_view, progress)
    _report_broken(broken, views, model.images_dir)
    return Scene(
        root=root,
        views=tuple(views),
        points=alignment.apply_points(model.points).to(torch.float32),
        point_colors=model.point_colors,
        alignment=alignment,
    )


def _unit_camera(image: ColmapImage) -> Camera:
    """The photo's pose; alignment looks at nothing else."""
    return Camera(viewmat=image.viewmat, K=torch.eye(3, dtype=torch.float64), width=1, height=1)


def _load_views(
    chosen: Sequence[ColmapImage],
    splits: dict[str, Split],
    load_view: Callable[[ColmapImage, Split], View],
    progress: Callable[[int, int], None] | None,
) -> tuple[list[View], list[tuple[str, str]]]:
    """Views in the order of their names, and (name, reason) of the photos that cannot be read."""
    views: list[View] = []
    broken: list[tuple[str, str]] = []

    def load(image: ColmapImage) -> View | str:
        try:
            return load_view(image, splits[image.name])
        except UnreadableImageError as error:
            return str(error)

    pool = ThreadPoolExecutor(DECODERS)
    try:
        for count, (image, view) in enumerate(zip(chosen, pool.map(load, chosen), strict=True), start=1):
            if isinstance(view, str):
                broken.append((image.name, view))
            else:
                views.append(view)
            if progress is not None:
                progress(count, len(chosen))
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
    return views, broken


def _cache_limit(config: DataConfig) -> int:
    limit, available = parse_bytes(config.image_cache), available_memory()
    return limit if available is None else min(limit, int(CACHE_SHARE * available))


def _load_view(
    image: ColmapImage,
    split: Split,
    alignment: Alignment,
    images_dir: Path,
    root: Path,
    config: DataConfig,
    cache: ImageCache,
) -> View:
    camera, files = _place(image, alignment, images_dir, root, config)
    pictures = files.load(use_mask=config.use_masks, use_depth=config.use_depth)
    # A disparity map that is missing or broken now is not looked for, and warned of, again.
    again = partial(files.load, use_mask=config.use_masks, use_depth=pictures.disparity is not None)
    cached = CachedPictures(cache, image.name, files.photo, again)
    cache.put(image.name, pictures, keep=split == "train")
    return View(
        name=image.name,
        camera=camera,
        split=split,
        read_photo=lambda: cached.get().read_photo(),
        read_mask=lambda: cached.get().read_mask(),
        read_disparity=lambda: cached.get().read_disparity(),
        read_clean=files.read_clean,
        read_truth_mask=files.read_truth_mask,
        prefetch=cached.prefetch,
    )


def _lazy_view(
    image: ColmapImage, split: Split, alignment: Alignment, images_dir: Path, root: Path, config: DataConfig
) -> View:
    camera, files = _place(image, alignment, images_dir, root, config)
    later = _LaterPictures(files, config)
    return View(
        name=image.name,
        camera=camera,
        split=split,
        read_photo=lambda: _decode(later).read_photo(),
        read_mask=lambda: _decode(later).read_mask(),
        read_disparity=lambda: _decode(later).read_disparity(),
        read_clean=files.read_clean,
        read_truth_mask=files.read_truth_mask,
    )


class _LaterPictures:
    """A photo that is not decoded yet; known to the cache by identity."""

    def __init__(self, files: PhotoFiles, config: DataConfig) -> None:
        self.files, self.config = files, config


@lru_cache(maxsize=KEPT_PICTURES)
def _decode(later: _LaterPictures) -> Pictures:
    try:
        return later.files.load(use_mask=later.config.use_masks, use_depth=later.config.use_depth)
    except UnreadableImageError as error:
        raise UserError(f"{later.files.photo}: {error}; mend the file or choose another photo") from error


def _place(
    image: ColmapImage, alignment: Alignment, images_dir: Path, root: Path, config: DataConfig
) -> tuple[Camera, PhotoFiles]:
    """The photo's camera in the aligned frame, and where its files are."""
    if image.camera.is_spherical():
        raise UserError(f"{image.name}: spherical cameras ({image.camera.model_name}) are not supported")
    size = (image.camera.width, image.camera.height)
    if size[0] * size[1] > config.max_image_pixels:
        raise UnreadableImageError(
            f"its camera has {size[0]}x{size[1]} pixels, more than --max-image-pixels {config.max_image_pixels}"
        )
    grid = PixelGrid.from_colmap(image.camera, config.downscale)
    camera = alignment.apply_camera(Camera(image.viewmat, grid.K, grid.width, grid.height))
    files = PhotoFiles(root, images_dir, image.name, grid, config.max_image_pixels)
    return replace(camera, viewmat=camera.viewmat.float(), K=camera.K.float()), files


def _report_broken(broken: Sequence[tuple[str, str]], views: Sequence[View], images_dir: Path) -> None:
    """Name the photos left out; stop where no photo is left to train."""
    described = describe_names([f"{name} ({reason})" for name, reason in broken])
    if not any(view.split == "train" for view in views):
        raise UserError(f"{images_dir}: no photo to train can be read: {described}")
    if broken:
        warnings.warn(
            f"{len(broken)} photos in {images_dir} cannot be read and are left out: {described}",
            WildGSWarning,
            stacklevel=3,
        )
