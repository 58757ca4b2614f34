"""What a new photo is localised against: SIFT descriptors of a scene's triangulated points.

Works for any COLMAP scene whose photos observe its points (the tracks in images and points3D): features are found
anew in the photos, and one that lies where the model has an observation stands for that observation's point. So no
database of the reconstruction has to be kept.
"""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from jaxtyping import Float64, Int64, Shaped, UInt8
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save
from scipy.spatial import KDTree

from wildgs.errors import UserError
from wildgs.scene.colmap import find_model
from wildgs.sfm.mapping import quiet

MAX_PHOTOS = 200
"""Photos whose features are found; of larger scenes those that observe the most points."""

MAX_IMAGE_SIZE = 1600
"""Features are sought at no more than this many pixels on the long side."""

SAME_PLACE = 0.0025
"""A feature and an observation are one within this share of the photo's long side (2 pixels of 800)."""

BATCH = 8

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class FeatureIndex:
    """Triangulated points by what they look like.

    Attributes:
        descriptors: SIFT, as COLMAP stores it (root of L1-normalised, norm about 512).
        owners: For every descriptor, its row in `points`.
        points: Positions in the model's own frame.
    """

    descriptors: UInt8[np.ndarray, "D 128"]
    owners: Int64[np.ndarray, " D"]
    points: Float64[np.ndarray, "P 3"]


def load_feature_index(
    root: Path, cache: Path | None = None, progress: Progress | None = None
) -> FeatureIndex:
    """The landmarks of a scene, from the cache where it fits the scene's model.

    Args:
        root: The scene's folder.
        cache: File that keeps them; None keeps nothing, and a folder that cannot be written to is no fault.
        progress: Called with (photos looked at, photos in all).

    Raises:
        UserError: The model cannot be read, or its photos observe no points.
    """
    folder, images_dir = find_model(root)
    try:
        model = pycolmap.Reconstruction(folder)
    except Exception as error:  # pycolmap raises ValueError, RuntimeError, MemoryError, ... on broken files
        raise UserError(f"{folder}: the COLMAP model cannot be read; make it anew") from error
    state = _digest(model)
    kept = _read_cache(cache, state) if cache is not None else None
    if kept is not None:
        return kept
    landmarks = _find_landmarks(model, images_dir, progress)
    if cache is not None:
        _write_cache(cache, landmarks, state)
    return landmarks


def _digest(model: Any) -> str:
    digest = hashlib.sha256(str(sorted(image.name for image in model.images.values())).encode())
    for _, point in sorted(model.points3D.items()):
        digest.update(point.xyz.tobytes())
    return digest.hexdigest()


def _read_cache(file: Path, state: str) -> FeatureIndex | None:
    try:
        with safe_open(file, framework="np") as opened:
            if (opened.metadata() or {}).get("model") != state:
                return None
            return FeatureIndex(*(opened.get_tensor(key) for key in ("descriptors", "owners", "points")))
    except (OSError, SafetensorError):
        return None


def _write_cache(file: Path, landmarks: FeatureIndex, state: str) -> None:
    aside = file.with_name(file.name + ".part")
    try:
        aside.write_bytes(save(dict(vars(landmarks)), metadata={"model": state}))
        aside.replace(file)
    except (OSError, SafetensorError):
        aside.unlink(missing_ok=True)


def _find_landmarks(model: Any, images_dir: Path, progress: Progress | None) -> FeatureIndex:
    chosen = _best_connected(model)
    if not chosen:
        raise UserError(f"{images_dir}: the COLMAP model says of no photo which points it observes")
    ids = sorted(model.points3D)
    rows = {point_id: row for row, point_id in enumerate(ids)}
    points = np.array([model.points3D[point_id].xyz for point_id in ids], dtype=np.float64)
    descriptors, owners = [np.zeros((0, 128), np.uint8)], [np.zeros(0, np.int64)]
    with tempfile.TemporaryDirectory(prefix="wildgs-features-") as work, quiet():
        database = Path(work) / "features.db"
        for start in range(0, len(chosen), BATCH):
            batch = chosen[start : start + BATCH]
            extract_named(database, images_dir, [image.name for image in batch])
            with closing(pycolmap.Database.open(database)) as opened:
                for image in batch:
                    found, whose = _described_points(opened, image, rows)
                    descriptors.append(found)
                    owners.append(whose)
            if progress is not None:
                progress(min(start + BATCH, len(chosen)), len(chosen))
    landmarks = FeatureIndex(np.concatenate(descriptors), np.concatenate(owners), points)
    if len(landmarks.descriptors) == 0:
        raise UserError(
            f"{images_dir}: no SIFT feature lies where the COLMAP model has its observations; new photos cannot be"
            " localised against it"
        )
    return landmarks


def _best_connected(model: Any) -> list[Any]:
    """The posed photos that observe the most points, at most `MAX_PHOTOS`, by name."""
    posed = [image for image in model.images.values() if image.has_pose and image.num_points3D > 0]
    posed.sort(key=lambda image: (-image.num_points3D, image.name))
    return sorted(posed[:MAX_PHOTOS], key=lambda image: image.name)


def extract_named(database: Path, images_dir: Path, names: Sequence[str]) -> None:
    """Finds SIFT features of photos by name; what COLMAP cannot read is passed over."""
    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size = MAX_IMAGE_SIZE
    pycolmap.extract_features(
        database, images_dir, list(names), pycolmap.CameraMode.PER_IMAGE, extraction_options=options
    )


def _described_points(
    database: Any, image: Any, rows: dict[int, int]
) -> tuple[UInt8[np.ndarray, "D 128"], Int64[np.ndarray, " D"]]:
    """Descriptors of the features at a photo's observations, and the rows of the points observed."""
    nothing = np.zeros((0, 128), np.uint8), np.zeros(0, np.int64)
    stored = database.read_image_with_name(image.name)
    if stored is None or not database.exists_descriptors(stored.image_id):
        return nothing
    features = database.read_keypoints(stored.image_id)[:, :2].astype(np.float64)
    observed = [point for point in image.points2D if point.has_point3D()]
    if len(features) == 0 or not observed:
        return nothing
    taken = database.read_camera(stored.camera_id)
    camera = image.camera
    features = features * [camera.width / taken.width, camera.height / taken.height]
    reach = SAME_PLACE * max(camera.width, camera.height)
    positions = np.array([point.xy for point in observed])
    found = KDTree(positions).query(features, distance_upper_bound=max(reach, 1.0))
    distance, nearest = np.asarray(found[0]), np.asarray(found[1])
    near = np.isfinite(distance)
    owners = np.array([rows[point.point3D_id] for point in observed], dtype=np.int64)
    return database.read_descriptors(stored.image_id).data[near], owners[nearest[near]]


def match_features(
    features: UInt8[np.ndarray, "F 128"], landmarks: FeatureIndex, ratio: float
) -> tuple[Int64[np.ndarray, " M"], Int64[np.ndarray, " M"]]:
    """Features that look like one point and like no other (Lowe's ratio test, over points instead of features).

    Args:
        features: Descriptors of a new photo.
        landmarks: What is sought.
        ratio: Largest distance to the best point, relative to the best of all other points.

    Returns:
        Rows of features and of points; every point once, with the feature most like it.
    """
    likeness, owners = _nearest(features, landmarks)
    distance = np.arccos(np.clip(likeness, -1, 1))
    rivals = np.where(owners == owners[:, :1], np.inf, distance).min(axis=1)
    good = np.flatnonzero(distance[:, 0] < ratio * np.minimum(rivals, np.pi / 2))
    best: dict[int, int] = {}
    for feature in good[np.argsort(-distance[good, 0])]:
        best[int(owners[feature, 0])] = int(feature)  # the last written is the nearest
    return np.array(list(best.values()), np.int64), np.array(list(best.keys()), np.int64)


def _nearest(
    features: UInt8[np.ndarray, "F 128"], landmarks: FeatureIndex, count: int = 8, block: int = 65_536
) -> tuple[Shaped[np.ndarray, "F k"], Int64[np.ndarray, "F k"]]:
    """Cosine and owner of the descriptors most alike, the best first, without the whole table in memory."""
    import torch

    queries = torch.nn.functional.normalize(torch.from_numpy(features).float(), dim=1)
    owners = torch.from_numpy(landmarks.owners)
    likeness, best = torch.zeros(len(queries), 0), torch.zeros(len(queries), 0, dtype=torch.int64)
    for start in range(0, len(owners), block):
        rows = torch.from_numpy(landmarks.descriptors[start : start + block]).float()
        cosines = queries @ torch.nn.functional.normalize(rows, dim=1).T
        found = cosines.topk(min(count, len(rows)), dim=1)
        likeness = torch.cat([likeness, found.values], dim=1)
        best = torch.cat([best, owners[start : start + block][found.indices]], dim=1)
        order = likeness.topk(min(count, likeness.shape[1]), dim=1)
        likeness, best = order.values, best.gather(1, order.indices)
    return likeness.numpy(), best.numpy()
