"""Features of a model moved to where photos show the same, which a detector finds half a pixel off.

A feature is where one photo has an extremum of the difference of Gaussians. Another light, another viewpoint or
noise moves it, and cameras can be no better than their features. The photos around the observations of a point are
aligned with each other instead (`wildgs.sfm.track_kernels`), as proposed by Furukawa and Ponce, "Accurate camera
calibration from multi-view stereo and bundle adjustment", International Journal of Computer Vision 84, 2009: each
patch is warped as the cameras say it would look from another one, on a plane that faces the mean of them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pycolmap
from jaxtyping import Float64, UInt8
from numpy.lib.stride_tricks import sliding_window_view
from PIL import Image
from scipy.ndimage import gaussian_filter

from wildgs.progress import Counter
from wildgs.scene.config import MAX_IMAGE_PIXELS
from wildgs.scene.images import read_photo
from wildgs.sfm.track_kernels import FARTHEST, RADIUS, align_tracks
from wildgs.sfm.tracks import Tracks, rows_by_photo
from wildgs.sfm.workplace import Workplace
from wildgs.threads import launch

SMOOTHING = 0.5
"""Standard deviation by which photos are smoothed, pixels."""

PATCH_SPREAD = 0.6
"""Standard deviation of the weights of a patch's samples, relative to its radius."""

WINDOW = 2 * (2 * RADIUS + int(FARTHEST)) + 1
"""Side of the part of a photo in which an observation is aligned, pixels. A patch may be twice as large as that of
the reference and is then sampled in pixels of two."""

LARGEST_STRETCH = 64.0
"""Upper bound on the pixels of a photo for each pixel in which a patch is sampled. Of patches that are larger yet,
only a part is in the window, and they are not aligned."""

Observation = tuple[int, int]
"""Image id, and index of the feature."""


def refine_keypoints(
    work: Workplace, model: Any, progress: Counter, max_pixels: int = MAX_IMAGE_PIXELS
) -> tuple[Any, set[Observation]]:
    """Moves the features of points that several photos show to where these show the same.

    Args:
        work: The workplace with the photos, and the database with their features.
        model: The model, whose cameras and points say how patches are warped; not modified.
        progress: Called with (photos read, total number of photos).
        max_pixels: Largest number of pixels of a photo.

    Returns:
        A copy of the model with moved features, and the observations that could be aligned.
    """
    tracks = Tracks.of(work, model)
    stretch = np.sqrt(np.abs(np.linalg.det(tracks.warps)))
    scales = 2.0 ** np.round(np.log2(np.clip(stretch, 1.0, LARGEST_STRETCH)))
    warps = tracks.warps / scales[:, None, None]
    windows, places = cut_windows(work, model, tracks, scales, progress, max_pixels)
    moves, likeness = np.zeros_like(tracks.pixels), np.full(len(tracks.photos), -1.0)
    launch(
        align_tracks, windows, places, warps, tracks.starts, tracks.references, patch_weights(), moves, likeness,
        items=len(tracks.references),
    )  # fmt: skip
    moved, aligned = pycolmap.Reconstruction(model), set()
    for row in np.flatnonzero(likeness > 0):
        photo, feature = int(tracks.photos[row]), int(tracks.features[row])
        moved.image(photo).point2D(feature).xy = tracks.pixels[row] + scales[row] * moves[row]
        aligned.add((photo, feature))
    return moved, aligned


def patch_weights() -> Float64[np.ndarray, " K"]:
    """Weights of a patch's samples, which decrease from its centre; their sum is 1."""
    line = np.arange(-RADIUS, RADIUS + 1) / (PATCH_SPREAD * RADIUS)
    weights = np.exp(-0.5 * (line[:, None] ** 2 + line**2)).reshape(-1)
    return weights / weights.sum()


def cut_windows(
    work: Workplace,
    model: Any,
    tracks: Tracks,
    scales: Float64[np.ndarray, " O"],
    progress: Counter,
    max_pixels: int = MAX_IMAGE_PIXELS,
) -> tuple[UInt8[np.ndarray, "O S S"], Float64[np.ndarray, "O 2"]]:
    """Cuts out what photos show around observations; beyond their edges it is 0.

    Args:
        work: The workplace with the photos.
        model: pycolmap's reconstruction, which knows their names.
        tracks: The observations.
        scales: Side of the pixels of each window, a power of two, in pixels of the photo.
        progress: Called with (photos read, total number of photos).
        max_pixels: Largest number of pixels of a photo.

    Returns:
        Grey values, and the column and row of the observation in each window.
    """
    windows = np.zeros((len(scales), WINDOW, WINDOW), np.uint8)
    places = np.zeros((len(scales), 2))
    photos = list(rows_by_photo(tracks.photos))
    for done, (photo, rows) in enumerate(photos, start=1):
        pixels = read_photo(work.images / model.image(photo).name, max_pixels=max_pixels).pixels
        grey = Image.fromarray(pixels).convert("L")
        for scale in np.unique(scales[rows]):
            smaller = grey.reduce(int(scale)) if scale > 1 else grey
            smooth = np.round(gaussian_filter(np.asarray(smaller, np.float32), SMOOTHING)).astype(np.uint8)
            padded = np.pad(smooth, WINDOW // 2)
            views = sliding_window_view(padded, (WINDOW, WINDOW))
            these = rows[scales[rows] == scale]
            exact = tracks.pixels[these] / scale - 0.5
            corners = np.clip(np.round(exact).astype(np.int64), 0, np.array(smooth.shape[::-1]) - 1)
            windows[these] = views[corners[:, 1], corners[:, 0]]
            places[these] = exact - corners + WINDOW // 2
        progress(done, len(photos))
    return windows, places
