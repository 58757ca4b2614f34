"""COLMAP models, binary or text, in the folder layouts of Phototourism data."""

from __future__ import annotations

import itertools
import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32, Int, Int64, UInt8, UInt64
from torch import Tensor

from wildgs.errors import UserError, WildGSWarning
from wildgs.files import describe_names
from wildgs.geometry.camera import quats_to_rotations
from wildgs.scene.colmap_binary import read_binary
from wildgs.scene.colmap_records import ImageRecord, ModelFileError, ModelRecords, PointRecords
from wildgs.scene.colmap_text import read_text

LAYOUTS = (
    ("sparse/0", "images"),
    ("sparse", "images"),
    ("dense/sparse/0", "dense/images"),
    ("dense/sparse", "dense/images"),
)
"""Folders of the model and of its photos, relative to the scene; the first one with a model is used."""

MAX_COORDINATE = 1e12
"""Largest valid coordinate of poses and points, in model units."""

MODEL_FILES = (("cameras.bin", "images.bin", "points3D.bin"), ("cameras.txt", "images.txt", "points3D.txt"))


@dataclass(frozen=True)
class ColmapImage:
    """A registered photo of the model.

    Attributes:
        name: Path relative to the image folder, with forward slashes.
        camera: pycolmap's camera (any model), for the stored pixel grid of the photo.
        viewmat: World-to-camera transform in the model's frame.
        median_depth: Median depth of the points that this photo observes; None without observations.
        shown: Indices of the points that SfM found in this photo.
        pixels: Where: pixels (x, y) of `camera`, not undistorted.
    """

    name: str
    camera: Any
    viewmat: Float[Tensor, "4 4"]
    median_depth: float | None
    shown: Int64[np.ndarray, " K"]
    pixels: Float32[np.ndarray, "K 2"]


@dataclass(frozen=True)
class ColmapModel:
    """A sparse model: photos with poses, sorted by name, and finite points.

    Attributes:
        images_dir: The folder of the photos.
        images: Photos with poses.
        points: Positions in the model's frame.
        point_colors: Colours of the points.
        observations: Index in `images` and index in `points` of each observation of a point in a photo.
    """

    images_dir: Path
    images: tuple[ColmapImage, ...]
    points: Float[Tensor, "P 3"]
    point_colors: UInt8[Tensor, "P 3"]
    observations: Int[Tensor, "T 2"]


def find_model(root: Path) -> tuple[Path, Path]:
    """Finds the folders of a scene's sparse model and of its photos.

    Raises:
        UserError: The scene, the model or the folder of photos does not exist.
    """
    if not root.is_dir():
        raise UserError(f"{root}: no such folder; give the folder of a COLMAP scene (images/ and sparse/0/)")
    for sparse, images in LAYOUTS:
        model = root / sparse
        if any(all((model / name).is_file() for name in names) for names in MODEL_FILES):
            if not (root / images).is_dir():
                raise UserError(f"{root / images}: no such folder; put the photos of {model} there")
            return model, root / images
    raise UserError(
        f"{root}: no COLMAP model (cameras, images, points3D as .bin or .txt) in sparse/0, sparse or"
        " dense/sparse; `wildgs sfm PHOTOS --output SCENE` creates one"
    )


def read_model(root: Path) -> ColmapModel:
    """Reads the sparse model of a scene folder.

    Args:
        root: The scene folder.

    Returns:
        All photos with a pose, sorted by name, and all points with finite coordinates, in the model's frame (double
        precision).

    Raises:
        UserError: The model is missing, cannot be read, or has no photos with a pose or no points.
    """
    folder, images_dir = find_model(root)
    binary = all((folder / name).is_file() for name in MODEL_FILES[0])
    try:
        records = read_binary(folder) if binary else read_text(folder)
    except (ModelFileError, OSError, MemoryError) as error:
        raise UserError(f"{folder}: the COLMAP model cannot be read ({error}); rebuild it") from error
    registered = _usable(records, folder)
    with np.errstate(invalid="ignore"):
        finite = np.all(np.abs(records.points.xyz) < MAX_COORDINATE, axis=1)
    if not finite.any():
        raise UserError(f"{folder}: the COLMAP model has no points, which training needs; triangulate it")
    viewmats = {image.image_id: _viewmat(image) for image in registered}
    depths = _median_depths(records.points, finite, viewmats)
    images, ids = [], records.points.ids[finite]
    for image in registered:
        shown, pixels = _shown_points(image, ids)
        images.append(
            ColmapImage(
                name=_checked_name(image.name, folder),
                camera=records.cameras[image.camera_id],
                viewmat=torch.from_numpy(viewmats[image.image_id]),
                median_depth=depths.get(image.image_id),
                shown=shown,
                pixels=pixels,
            )
        )
    _refuse_repeated([image.name for image in images], folder)
    points, colors = records.points.xyz[finite], records.points.rgb[finite]
    observations = _observations(records.points, finite, [image.image_id for image in registered])
    return ColmapModel(
        images_dir, tuple(images), torch.from_numpy(points), torch.from_numpy(colors), observations
    )


def _shown_points(
    image: ImageRecord, ids: UInt64[np.ndarray, " P"]
) -> tuple[Int64[np.ndarray, " K"], Float32[np.ndarray, "K 2"]]:
    """Indices in `ids`, which are sorted, of the points that a photo shows, and their pixels."""
    found = np.searchsorted(ids, image.points.point_ids).clip(max=len(ids) - 1)
    usable = ids[found] == image.points.point_ids
    return found[usable].astype(np.int64), image.points.pixels[usable]


def _observations(points: PointRecords, finite: np.ndarray, image_ids: Sequence[int]) -> Int[Tensor, "T 2"]:
    """Index of the photo and index of the finite point, for every observation."""
    order = np.argsort(np.array(image_ids, dtype=np.int64), kind="stable")
    ids = np.array(image_ids, dtype=np.int64)[order]
    found = np.searchsorted(ids, points.track_image).clip(max=len(ids) - 1)
    usable = (ids[found] == points.track_image) & finite[points.track_point]
    rows = np.cumsum(finite) - 1
    pairs = np.stack([order[found[usable]], rows[points.track_point[usable]]], axis=1)
    return torch.from_numpy(pairs.astype(np.int32))


def _usable(records: ModelRecords, folder: Path) -> list[ImageRecord]:
    """Photos with a valid camera and pose, sorted by name; warns of the others."""
    images = sorted(records.images, key=lambda image: image.name)
    if not images:
        raise UserError(
            f"{folder}: the COLMAP model has no photos with a pose; run `wildgs sfm` on the photos"
        )
    if len({image.image_id for image in images}) != len(images):
        raise UserError(f"{folder}: two photos of the COLMAP model have the same id; rebuild it")
    faults = {image.name: fault for image in images if (fault := _fault(image, records.cameras))}
    good = [image for image in images if image.name not in faults]
    described = describe_names([f"{name!r} ({fault})" for name, fault in faults.items()])
    if not good:
        raise UserError(f"{folder}: no photo of the COLMAP model can be used: {described}; rebuild it")
    if faults:
        warnings.warn(
            f"{folder}: {len(faults)} photos cannot be used and are left out: {described}",
            WildGSWarning,
            stacklevel=3,
        )
    return good


def _fault(image: ImageRecord, cameras: dict[int, Any]) -> str | None:
    """The reason why a photo cannot be used, or None."""
    camera = cameras.get(image.camera_id)
    if camera is None:
        return f"camera {image.camera_id} does not exist"
    params = np.array(camera.params)
    if not np.isfinite(params).all() or not all(params[i] > 0 for i in camera.focal_length_idxs()):
        return "the parameters of its camera are invalid"
    pose = np.array([*image.quat, *image.translation])
    if not np.isfinite(pose).all() or np.abs(pose).max() > MAX_COORDINATE:
        return "its pose is non-finite"
    return None if np.linalg.norm(image.quat) > 1e-12 else "its rotation is zero"


def _refuse_repeated(names: Sequence[str], folder: Path) -> None:
    repeated = sorted({a for a, b in itertools.pairwise(names) if a == b})
    if repeated:
        raise UserError(f"{folder}: the photo {repeated[0]!r} is in the COLMAP model twice; rebuild it")


def _checked_name(name: str, folder: Path) -> str:
    """Checks that a photo's name stays within the image folder, since paths of other files are derived from it."""
    path = PurePosixPath(name.replace("\\", "/"))
    outside = path.is_absolute() or ".." in path.parts or PureWindowsPath(name).drive
    outside = outside or (os.name == "nt" and ":" in name)
    if outside or not path.name or any(character < " " for character in name):
        raise UserError(
            f"{folder}: the photo {name!r} lies outside the image folder; give it a name within it"
        )
    return str(path)


def _viewmat(image: ImageRecord) -> np.ndarray:
    quat = torch.tensor(image.quat, dtype=torch.float64)
    viewmat = np.eye(4)
    viewmat[:3, :3] = quats_to_rotations(quat[None] / quat.norm())[0].numpy()
    viewmat[:3, 3] = image.translation
    return viewmat


def _median_depths(
    points: PointRecords, finite: np.ndarray, viewmats: dict[int, np.ndarray]
) -> dict[int, float]:
    """Median depth of the points that each photo observes, model units."""
    rows, photos = points.track_point, points.track_image
    valid = finite[rows]
    rows, photos = rows[valid], photos[valid]
    if len(rows) == 0:
        return {}
    order = np.argsort(photos, kind="stable")
    ids, starts = np.unique(photos[order], return_index=True)
    depths = {}
    for image_id, seen in zip(ids.tolist(), np.split(rows[order], starts[1:]), strict=True):
        if image_id in viewmats:
            row = viewmats[image_id][2]
            depth = points.xyz[seen] @ row[:3] + row[3]
            if (depth > 0).any():
                depths[image_id] = float(np.median(depth[depth > 0]))
    return depths
