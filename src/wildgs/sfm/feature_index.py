"""An index of SIFT descriptors of a scene's triangulated points, for localising new photos.

Features are extracted from the scene's photos; those at the observations of a point are its descriptors. This only
needs the data in a run folder (`wildgs.scene.carried`), not the database of the reconstruction.
"""

from __future__ import annotations

import contextlib
import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
import torch
from jaxtyping import Float, Float64, Int, Int64, Shaped, UInt8
from PIL import Image
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save
from scipy.spatial import KDTree
from torch import Tensor

from wildgs.errors import UserError
from wildgs.files import check_regular, written_aside
from wildgs.progress import Counter
from wildgs.scene import Scene, View
from wildgs.sfm.mapping import quiet

MAX_PHOTOS = 200
"""Upper bound on the number of photos in the index, those that observe the most points."""

MAX_IMAGE_SIZE = 1600
"""Longest side in pixels at which features are extracted."""

SAME_PLACE = 0.0025
"""Largest distance of a feature from the observation of its point, relative to the photo's longer side."""


@dataclass(frozen=True)
class FeatureIndex:
    """Triangulated points with their descriptors.

    Attributes:
        descriptors: SIFT descriptors as stored by COLMAP (square root of L1-normalised, norm about 512).
        owners: Index in `points` of every descriptor.
        points: Positions in the aligned frame.
    """

    descriptors: UInt8[np.ndarray, "D 128"]
    owners: Int64[np.ndarray, " D"]
    points: Float64[np.ndarray, "P 3"]


def load_feature_index(
    scene: Scene, cache: Path | None = None, progress: Counter | None = None
) -> FeatureIndex:
    """Creates the feature index of a scene, or reads it from a valid cache.

    Args:
        scene: The scene with photos, cameras, points and observations.
        cache: File that caches the index; None does not cache, and a file that cannot be written is ignored.
        progress: Called with (photos done, total number of photos).

    Raises:
        UserError: The scene's photos observe no points, or cannot be read.
    """
    state = _digest(scene)
    kept = _read_cache(cache, state) if cache is not None else None
    if kept is not None:
        return kept
    index = _index_features(scene, progress)
    if cache is not None:
        with contextlib.suppress(UserError), written_aside(cache) as aside:
            aside.write_bytes(save(dict(vars(index)), metadata={"scene": state}))
    return index


def _digest(scene: Scene) -> str:
    digest = hashlib.sha256(repr([view.name for view in scene.views]).encode(errors="surrogateescape"))
    for tensor in (scene.points, scene.observations):
        digest.update(tensor.contiguous().numpy().tobytes())
    return digest.hexdigest()


def _read_cache(file: Path, state: str) -> FeatureIndex | None:
    try:
        check_regular(file)
        with safe_open(file, framework="np") as opened:
            if (opened.metadata() or {}).get("scene") != state:
                return None
            return FeatureIndex(*(opened.get_tensor(key) for key in ("descriptors", "owners", "points")))
    except (OSError, SafetensorError):
        return None


def _index_features(scene: Scene, progress: Counter | None) -> FeatureIndex:
    counts = torch.bincount(scene.observations[:, 0].long(), minlength=len(scene.views))
    chosen = counts.argsort(descending=True, stable=True)[:MAX_PHOTOS]
    chosen = chosen[counts[chosen] > 0].sort().values.tolist()
    if not chosen:
        raise UserError(
            f"{scene.root}: the sparse model has no observations of points, so new photos cannot be localised; "
            "choose a photo of the scene whose camera is used for them (--like)"
        )
    points = scene.points.double().numpy()
    descriptors, owners = [np.zeros((0, 128), np.uint8)], [np.zeros(0, np.int64)]
    for done, row in enumerate(chosen, start=1):
        observed = scene.observations[scene.observations[:, 0] == row][:, 1].long()
        with contextlib.suppress(UserError):  # unreadable photos are skipped
            found, whose = _described_points(scene.views[row], scene.points, observed)
            descriptors.append(found)
            owners.append(whose)
        if progress is not None:
            progress(done, len(chosen))
    index = FeatureIndex(np.concatenate(descriptors), np.concatenate(owners), points)
    if len(index.descriptors) == 0:
        raise UserError(
            f"{scene.root}: no SIFT feature of its photos is at a point of the sparse model, so new photos cannot "
            "be localised; choose a photo of the scene whose camera is used for them (--like)"
        )
    return index


def _described_points(
    view: View, points: Float[Tensor, "P 3"], observed: Int[Tensor, " O"]
) -> tuple[UInt8[np.ndarray, "D 128"], Int64[np.ndarray, " D"]]:
    """Descriptors of the features at a photo's observations, and the indices of the observed points."""
    camera = view.camera
    detail = view.photos.detail or MAX_IMAGE_SIZE
    features, descriptors = find_features(view.read_photo().numpy(), min(MAX_IMAGE_SIZE, detail))
    positions, depth = camera.project(points[observed])
    in_front = depth > 0
    positions, owners = positions[in_front].double().numpy(), observed[in_front].numpy()
    if len(features) == 0 or len(owners) == 0:
        return np.zeros((0, 128), np.uint8), np.zeros(0, np.int64)
    long_side = max(camera.width, camera.height)
    reach = max(SAME_PLACE * long_side, long_side / min(long_side, detail))
    found = KDTree(positions).query(features, distance_upper_bound=reach)
    distance, nearest = np.asarray(found[0]), np.asarray(found[1])
    near = np.isfinite(distance)
    return descriptors[near], owners[nearest[near]]


def find_features(
    pixels: UInt8[np.ndarray, "H W 3"], limit: int = MAX_IMAGE_SIZE
) -> tuple[Float64[np.ndarray, "F 2"], UInt8[np.ndarray, "F 128"]]:
    """SIFT features of an RGB photo: positions in pixels, and descriptors.

    Features are extracted at a longer side of at most `limit` pixels.
    """
    height, width = pixels.shape[:2]
    grey = Image.fromarray(pixels).convert("L")
    grey.thumbnail((limit, limit), Image.Resampling.LANCZOS)
    with quiet():
        extractor = pycolmap.FeatureExtractor.create(device=pycolmap.Device.cpu)
        keypoints, descriptors = extractor.extract_from_uint8_array(np.asarray(grey))
    found = np.array([(point.x, point.y) for point in keypoints], dtype=np.float64).reshape(-1, 2)
    return found * [width / grey.width, height / grey.height], np.array(descriptors.data).reshape(-1, 128)


def match_features(
    features: UInt8[np.ndarray, "F 128"], index: FeatureIndex, ratio: float
) -> tuple[Int64[np.ndarray, " M"], Int64[np.ndarray, " M"]]:
    """Matches features to points by Lowe's ratio test, applied to points instead of features.

    Args:
        features: Descriptors of a new photo.
        index: The points.
        ratio: Largest ratio of the distance to the best point and to the second best point.

    Returns:
        Indices of features and of points; every point occurs once, with its most similar feature.
    """
    return select_matches(*nearest_points(features, index), ratio)


def select_matches(
    likeness: Shaped[np.ndarray, "F k"], owners: Int64[np.ndarray, "F k"], ratio: float
) -> tuple[Int64[np.ndarray, " M"], Int64[np.ndarray, " M"]]:
    """The ratio test of `match_features` on the result of `nearest_points`."""
    distance = np.arccos(np.clip(likeness, -1, 1))
    rivals = np.where(owners == owners[:, :1], np.inf, distance).min(axis=1)
    good = np.flatnonzero(distance[:, 0] < ratio * np.minimum(rivals, np.pi / 2))
    best: dict[int, int] = {}
    for feature in good[np.argsort(-distance[good, 0])]:
        best[int(owners[feature, 0])] = int(feature)  # sorted by decreasing distance: the nearest is kept
    return np.array(list(best.values()), np.int64), np.array(list(best.keys()), np.int64)


def nearest_points(
    features: UInt8[np.ndarray, "F 128"], index: FeatureIndex, count: int = 8, block: int = 65_536
) -> tuple[Shaped[np.ndarray, "F k"], Int64[np.ndarray, "F k"]]:
    """Cosine similarity and owner of the most similar descriptors, best first, computed in blocks."""
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
