"""Index of SIFT features against which new photos are localised: descriptors of a scene's triangulated points.

Works for any COLMAP scene whose photos observe its points (the tracks in images and points3D): features are found
anew in the photos, and one that lies where the model has an observation stands for that observation's point. So no
database of the reconstruction has to be kept.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Float64, Int64, Shaped, UInt8
from PIL import Image
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save
from scipy.spatial import KDTree

from wildgs.errors import UserError
from wildgs.scene.colmap import find_model, read_records, usable_images
from wildgs.scene.colmap_records import ImageRecord, ModelRecords, PointRecords
from wildgs.scene.images import UnreadableImageError, read_photo
from wildgs.sfm.mapping import quiet

MAX_PHOTOS = 200
"""Photos whose features are indexed; of larger scenes those that observe the most points."""

MAX_IMAGE_SIZE = 1600
"""Photos are shrunk to this many pixels on the long side before features are extracted."""

SAME_PLACE = 0.0025
"""A feature and an observation are one within this share of the photo's long side (2 pixels of 800)."""

EXTRACTORS = 4
"""Photos in which features are sought at the same time."""

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class FeatureIndex:
    """Triangulated points with the descriptors of the features that show them.

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
    """The feature index of a scene, from the cache where it fits the scene's model.

    Model and photos are read in Python, as everywhere else; COLMAP gets decoded pixels.

    Args:
        root: The scene's folder.
        cache: File that keeps the index; None keeps nothing, and a folder that cannot be written to is no error.
        progress: Called with (photos done, photos in all).

    Raises:
        UserError: The model cannot be read, or its photos observe no points.
    """
    folder, images_dir = find_model(root)
    records = read_records(folder, observations=True)
    images = usable_images(records, folder)
    state = _digest(images, records.points)
    kept = _read_cache(cache, state) if cache is not None else None
    if kept is not None:
        return kept
    index = _build(records, images, images_dir, progress)
    if cache is not None:
        _write_cache(cache, index, state)
    return index


def _digest(images: Sequence[ImageRecord], points: PointRecords) -> str:
    digest = hashlib.sha256(str(sorted(image.name for image in images)).encode("utf-8", "surrogatepass"))
    digest.update(points.xyz.tobytes())
    return digest.hexdigest()


def _read_cache(file: Path, state: str) -> FeatureIndex | None:
    try:
        with safe_open(file, framework="np") as opened:
            if (opened.metadata() or {}).get("model") != state:
                return None
            return FeatureIndex(*(opened.get_tensor(key) for key in ("descriptors", "owners", "points")))
    except (OSError, SafetensorError):
        return None


def _write_cache(file: Path, index: FeatureIndex, state: str) -> None:
    aside = file.with_name(file.name + ".part")
    try:
        aside.write_bytes(save(dict(vars(index)), metadata={"model": state}))
        aside.replace(file)
    except (OSError, SafetensorError):
        aside.unlink(missing_ok=True)


def _build(
    records: ModelRecords, images: Sequence[ImageRecord], images_dir: Path, progress: Progress | None
) -> FeatureIndex:
    chosen = _best_connected(images)
    if not chosen:
        raise UserError(f"{images_dir}: the COLMAP model does not say which points its photos observe")
    descriptors, owners = [np.zeros((0, 128), np.uint8)], [np.zeros(0, np.int64)]
    with quiet(), ThreadPoolExecutor(EXTRACTORS) as pool:
        found = pool.map(lambda image: _described_points(image, records, images_dir), chosen)
        for done, (described, whose) in enumerate(found, start=1):
            descriptors.append(described)
            owners.append(whose)
            if progress is not None:
                progress(done, len(chosen))
    index = FeatureIndex(np.concatenate(descriptors), np.concatenate(owners), records.points.xyz)
    if len(index.descriptors) == 0:
        raise UserError(
            f"{images_dir}: no SIFT feature lies where the COLMAP model has its observations; new photos cannot be"
            " localised against it"
        )
    return index


def _best_connected(images: Sequence[ImageRecord]) -> list[ImageRecord]:
    """The photos that observe the most points, at most `MAX_PHOTOS`, by name."""
    connected = [image for image in images if image.observations is not None and len(image.observations.xy)]
    connected.sort(key=lambda image: (-len(image.observations.xy) if image.observations else 0, image.name))
    return sorted(connected[:MAX_PHOTOS], key=lambda image: image.name)


def sift_features(
    pixels: UInt8[np.ndarray, "H W 3"],
) -> tuple[Float64[np.ndarray, "F 2"], UInt8[np.ndarray, "F 128"]]:
    """SIFT features in a photo's pixels, and their descriptors."""
    height, width = pixels.shape[:2]
    grey = Image.fromarray(pixels).convert("L")
    grey.thumbnail((MAX_IMAGE_SIZE, MAX_IMAGE_SIZE), Image.Resampling.LANCZOS)
    extractor = pycolmap.FeatureExtractor.create(device=pycolmap.Device.cpu)
    keypoints, descriptors = extractor.extract_from_uint8_array(np.asarray(grey))
    found = np.array([(point.x, point.y) for point in keypoints], dtype=np.float64).reshape(-1, 2)
    return found * [width / grey.width, height / grey.height], np.array(descriptors.data)


def _described_points(
    image: ImageRecord, records: ModelRecords, images_dir: Path
) -> tuple[UInt8[np.ndarray, "D 128"], Int64[np.ndarray, " D"]]:
    """Descriptors of the features at a photo's observations, and the rows of the points observed.

    Photos that cannot be read, or have another shape than their camera, give none.
    """
    nothing = np.zeros((0, 128), np.uint8), np.zeros(0, np.int64)
    camera, observed = records.cameras[image.camera_id], image.observations
    try:
        pixels = read_photo(images_dir / image.name, camera_size=(camera.width, camera.height)).pixels
    except UnreadableImageError:
        return nothing
    features, descriptors = sift_features(pixels)
    if len(features) == 0 or observed is None:
        return nothing
    rows = np.searchsorted(records.points.ids, observed.point_ids).clip(max=len(records.points.ids) - 1)
    known = records.points.ids[rows] == observed.point_ids
    if not known.any():
        return nothing
    features = features * [camera.width / pixels.shape[1], camera.height / pixels.shape[0]]
    reach = SAME_PLACE * max(camera.width, camera.height)
    found = KDTree(observed.xy[known]).query(features, distance_upper_bound=max(reach, 1.0))
    distance, nearest = np.asarray(found[0]), np.asarray(found[1])
    near = np.isfinite(distance)
    return descriptors[near], rows[known][nearest[near]].astype(np.int64)


def match_features(
    features: UInt8[np.ndarray, "F 128"], index: FeatureIndex, ratio: float
) -> tuple[Int64[np.ndarray, " M"], Int64[np.ndarray, " M"]]:
    """Features that look like one point and like no other (Lowe's ratio test, over points instead of features).

    Args:
        features: Descriptors of a new photo.
        index: Points of the scene.
        ratio: Largest distance to the best point, relative to the best of all other points.

    Returns:
        Rows of features and of points; every point once, with the feature most like it.
    """
    likeness, owners = _nearest(features, index)
    distance = np.arccos(np.clip(likeness, -1, 1))
    rivals = np.where(owners == owners[:, :1], np.inf, distance).min(axis=1)
    good = np.flatnonzero(distance[:, 0] < ratio * np.minimum(rivals, np.pi / 2))
    best: dict[int, int] = {}
    for feature in good[np.argsort(-distance[good, 0])]:
        best[int(owners[feature, 0])] = int(feature)  # the last written is the nearest
    return np.array(list(best.values()), np.int64), np.array(list(best.keys()), np.int64)


def _nearest(
    features: UInt8[np.ndarray, "F 128"], index: FeatureIndex, count: int = 8, block: int = 65_536
) -> tuple[Shaped[np.ndarray, "F k"], Int64[np.ndarray, "F k"]]:
    """Cosine and owner of the descriptors most alike, the best first, without the whole table in memory."""
    import torch

    queries = torch.nn.functional.normalize(torch.from_numpy(features).float(), dim=1)
    owners = torch.from_numpy(index.owners)
    likeness, best = torch.zeros(len(queries), 0), torch.zeros(len(queries), 0, dtype=torch.int64)
    for start in range(0, len(owners), block):
        rows = torch.from_numpy(index.descriptors[start : start + block]).float()
        cosines = queries @ torch.nn.functional.normalize(rows, dim=1).T
        found = cosines.topk(min(count, len(rows)), dim=1)
        likeness = torch.cat([likeness, found.values], dim=1)
        best = torch.cat([best, owners[start : start + block][found.indices]], dim=1)
        order = likeness.topk(min(count, likeness.shape[1]), dim=1)
        likeness, best = order.values, best.gather(1, order.indices)
    return likeness.numpy(), best.numpy()
