"""Features of thumbnails: photos of few pixels without a pose are enlarged and their features extracted again.

SIFT finds few features in a thumbnail, most of them so small that their descriptors differ from those of the same
places in a larger photo. Enlarging adds no information, but its smooth pixels give features at the scales at which
other photos show them.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Collection, Sequence
from contextlib import closing
from typing import Any

import numpy as np
import pycolmap
from jaxtyping import Float32
from PIL import Image

from wildgs.scene.images import read_photo
from wildgs.sfm.database import open_database
from wildgs.sfm.matching import forget_pairs, image_ids
from wildgs.sfm.pairs import Pair
from wildgs.sfm.upright import WorkingCopy
from wildgs.sfm.workplace import Workplace

SMALL_SIDE = 320
"""Longer side, in pixels, up to which photos are enlarged."""
FACTOR = 3
"""Factor by which width and height are multiplied."""


def enlarge_small(
    work: Workplace, copies: Sequence[WorkingCopy], photos: Collection[int], max_features: int
) -> list[int]:
    """Replaces the features of small photos by those of enlarged copies, and deletes their matches.

    Args:
        work: The workplace; the features in its database are replaced.
        copies: All photos.
        photos: Photos to consider; those with a mask or more than `SMALL_SIDE` pixels are left alone.
        max_features: Upper bound on the number of features per photo.

    Returns:
        The photos with new features.
    """
    with open_database(work.database) as database:
        ids = image_ids(database, copies)
        known = {row: i for row, i in enumerate(ids) if row in photos and i is not None}
        small = {row: i for row, i in known.items() if _long_side(database, i) <= SMALL_SIDE}
        small = {row: i for row, i in small.items() if not copies[row].masked}
    if not small:
        return []
    pairs: set[Pair] = {(min(a, b), max(a, b)) for a in small for b in range(len(copies)) if a != b}
    forget_pairs(work, copies, pairs)
    # pycolmap can replace keypoints, but not descriptors.
    with closing(sqlite3.connect(work.database)) as opened, opened:
        for table in ("keypoints", "descriptors"):
            opened.executemany(f"DELETE FROM {table} WHERE image_id = ?", [(i,) for i in small.values()])
    with open_database(work.database) as database:
        for row, image_id in small.items():
            keypoints, descriptors = _features(work, copies[row], max_features)
            database.write_keypoints(image_id, keypoints)
            database.write_descriptors(image_id, descriptors)
    return sorted(small)


def _long_side(database: Any, image_id: int) -> int:
    camera = database.read_camera(database.read_image(image_id).camera_id)
    return max(camera.width, camera.height)


def _features(
    work: Workplace, copy: WorkingCopy, max_features: int
) -> tuple[Float32[np.ndarray, "F 6"], pycolmap.FeatureDescriptors]:
    """Keypoints, in pixels of the photo, and descriptors of the enlarged photo."""
    grey = Image.fromarray(read_photo(work.images / copy.work_name).pixels).convert("L")
    large = grey.resize((FACTOR * grey.width, FACTOR * grey.height), Image.Resampling.BICUBIC)
    options = pycolmap.FeatureExtractionOptions()
    options.sift.max_num_features = max_features
    extractor = pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)
    keypoints, descriptors = extractor.extract_from_uint8_array(np.asarray(large))
    rows = [(point.x, point.y, point.a11, point.a12, point.a21, point.a22) for point in keypoints]
    return np.array(rows, dtype=np.float32).reshape(-1, 6) / FACTOR, descriptors
