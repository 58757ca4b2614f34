"""COLMAP models, binary or text, in the folder layouts that photo-tourism data comes in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import pycolmap
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from wildgs.errors import UserError

LAYOUTS = (
    ("sparse/0", "images"),
    ("sparse", "images"),
    ("dense/sparse/0", "dense/images"),
    ("dense/sparse", "dense/images"),
)
"""Folders of a model and of its photos, relative to the scene; the first that holds a model counts."""

MODEL_FILES = (("cameras.bin", "images.bin", "points3D.bin"), ("cameras.txt", "images.txt", "points3D.txt"))


@dataclass(frozen=True)
class ColmapImage:
    """One registered photo as the model has it.

    Attributes:
        name: Path relative to the image folder, with forward slashes.
        camera: pycolmap's camera (any model), for the stored pixel grid of the photo.
        viewmat: World-to-camera in the model's own frame.
        median_depth: Median depth of the points that this photo observes, None where it observes none.
    """

    name: str
    camera: Any
    viewmat: Float[Tensor, "4 4"]
    median_depth: float | None


@dataclass(frozen=True)
class ColmapModel:
    """A sparse model: photos with poses, sorted by name, and finite points."""

    images_dir: Path
    images: tuple[ColmapImage, ...]
    points: Float[Tensor, "P 3"]
    point_colors: UInt8[Tensor, "P 3"]


def find_model(root: Path) -> tuple[Path, Path]:
    """The folders of a scene's sparse model and of its photos.

    Raises:
        UserError: There is no scene, no model or no folder of photos.
    """
    if not root.is_dir():
        raise UserError(f"{root}: no such folder; give the folder of a COLMAP scene (images/ and sparse/0/)")
    for sparse, images in LAYOUTS:
        model = root / sparse
        if any(all((model / name).is_file() for name in names) for names in MODEL_FILES):
            if not (root / images).is_dir():
                raise UserError(f"{root / images}: no such folder; the photos of {model} belong there")
            return model, root / images
    raise UserError(
        f"{root}: no COLMAP model (cameras, images, points3D as .bin or .txt) in sparse/0, sparse or"
        " dense/sparse; `wildgs sfm PHOTOS --output SCENE` makes one"
    )


def read_model(root: Path) -> ColmapModel:
    """Read the sparse model of a scene folder.

    Args:
        root: The scene's folder.

    Returns:
        All photos with a pose, in the order of their names, and the points with finite coordinates, in the
        model's own frame (double precision).

    Raises:
        UserError: The model is missing, cannot be read, holds no photo with a pose or no point.
    """
    folder, images_dir = find_model(root)
    try:
        reconstruction = pycolmap.Reconstruction(folder)
    except Exception as error:  # pycolmap raises ValueError, RuntimeError, MemoryError, ... on broken files
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise UserError(f"{folder}: the COLMAP model cannot be read ({reason}); make it anew") from error

    registered = sorted((i for i in reconstruction.images.values() if i.has_pose), key=lambda i: i.name)
    if not registered:
        raise UserError(
            f"{folder}: the COLMAP model holds no photo with a pose; run `wildgs sfm` on the photos"
        )
    point_ids, points, colors = _read_points(reconstruction)
    if len(points) == 0:
        raise UserError(
            f"{folder}: the COLMAP model holds no points, and training starts from them; triangulate it"
        )

    viewmats = {image.image_id: _viewmat(image) for image in registered}
    depths = _median_depths(reconstruction, point_ids, points, viewmats)
    images = tuple(
        ColmapImage(
            name=_checked_name(image.name, folder),
            # A copy: pycolmap's own belongs to the reconstruction and dies with it.
            camera=pycolmap.Camera(image.camera.todict()),
            viewmat=torch.from_numpy(viewmats[image.image_id]),
            median_depth=depths.get(image.image_id),
        )
        for image in registered
    )
    return ColmapModel(images_dir, images, torch.from_numpy(points), torch.from_numpy(colors))


def _checked_name(name: str, folder: Path) -> str:
    """A photo's name that stays within the image folder: other files are found, and written, by it."""
    path = PurePosixPath(name.replace("\\", "/"))
    if path.is_absolute() or ".." in path.parts or (path.parts and ":" in path.parts[0]):
        raise UserError(
            f"{folder}: the photo {name!r} lies outside the image folder; give it a name within it"
        )
    return str(path)


def _viewmat(image: Any) -> np.ndarray:
    viewmat = np.eye(4)
    viewmat[:3] = image.cam_from_world().matrix()
    return viewmat


def _read_points(reconstruction: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    # By id: the order in pycolmap's hash map may differ from one machine to the next.
    items = sorted(reconstruction.points3D.items())
    ids = np.array([point_id for point_id, _ in items], dtype=np.uint64)
    points = np.array([point.xyz for _, point in items], dtype=np.float64).reshape(-1, 3)
    colors = np.array([point.color for _, point in items], dtype=np.uint8).reshape(-1, 3)
    finite = np.isfinite(points).all(axis=1)
    return ids[finite], points[finite], colors[finite]


def _median_depths(
    reconstruction: Any, ids: np.ndarray, points: np.ndarray, viewmats: dict[int, np.ndarray]
) -> dict[int, float]:
    """Median depth of each photo's own points (those in its tracks), model units."""
    seen: dict[int, list[int]] = {}
    for index, point_id in enumerate(ids):
        for element in reconstruction.points3D[int(point_id)].track.elements:
            seen.setdefault(element.image_id, []).append(index)
    depths = {}
    for image_id, indices in seen.items():
        if image_id in viewmats:
            row = viewmats[image_id][2]
            depth = points[indices] @ row[:3] + row[3]
            if (depth > 0).any():
                depths[image_id] = float(np.median(depth[depth > 0]))
    return depths


def describe_names(names: Sequence[str], limit: int = 3) -> str:
    """The first few names for a message, with how many more there are."""
    shown = ", ".join(names[:limit])
    return shown if len(names) <= limit else f"{shown} and {len(names) - limit} more"
