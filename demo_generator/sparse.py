"""Sparse points as structure from motion would give them, written as a COLMAP model."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Bool, Float, Float32, Int, UInt8

from demo_generator.cameras import Viewpoint

_DEPTH_TOLERANCE = 0.01  # share of the depth by which a point seen elsewhere may miss the surface
_LONGEST_TRACK = 12
_PIXEL_STEP, _METRE_STEP = 1 / 32, 1 / 1024  # what is stored, far below the errors: short numbers compress


@dataclass(frozen=True)
class Photo:
    """A photo, as needed to compute sparse points.

    Attributes:
        name: File name.
        view: Camera.
        pixels: The photo.
        depth: Depth at the pixels' centres, metres; 0 = sky.
        visitor: Whether a pixel shows a visitor.
    """

    name: str
    view: Viewpoint
    pixels: UInt8[np.ndarray, "H W 3"]
    depth: Float32[np.ndarray, "H W"]
    visitor: Bool[np.ndarray, "H W"]


@dataclass(frozen=True)
class SparsePoint:
    """A point with the photos (by index) and pixels in which it is seen."""

    position: Float[np.ndarray, "3"]
    color: UInt8[np.ndarray, "3"]
    photos: Int[np.ndarray, " T"]
    pixels: Float[np.ndarray, "T 2"]


def find_points(
    photos: list[Photo], count: int, least_views: int, rng: np.random.Generator
) -> list[SparsePoint]:
    """Points on the place's surfaces, more of them where photos have detail, seen by several photos.

    Args:
        photos: All photos.
        count: How many points to look for; those that too few photos see are left out.
        least_views: Photos that have to see a point.
        rng: Randomness.
    """
    points: list[SparsePoint] = []
    per_photo = -(-count // len(photos))
    for photo in photos:
        pixels = _corners(photo, per_photo, rng)
        depth = photo.depth[pixels[:, 1].astype(int), pixels[:, 0].astype(int)].astype(float)
        positions = photo.view.unproject(pixels, depth)
        seen = np.stack([_visible(positions, other) for other in photos], axis=1)
        for position, row in zip(positions, seen, strict=True):
            if row.sum() >= least_views:
                points.append(_track(position, np.flatnonzero(row), photos, rng))
    return points


def write_model(photos: list[Photo], points: list[SparsePoint], folder: Path) -> None:
    """Writes cameras, poses and points in COLMAP's binary form."""
    folder.mkdir(parents=True, exist_ok=True)
    model = pycolmap.Reconstruction()
    observed: list[list[np.ndarray]] = [[] for _ in photos]
    tracks = [pycolmap.Track() for _ in points]
    for track, point in zip(tracks, points, strict=True):
        for photo, pixel in zip(point.photos, point.pixels, strict=True):
            track.add_element(int(photo) + 1, len(observed[photo]))
            observed[photo].append(pixel)
    for index, photo in enumerate(photos, start=1):
        view = photo.view
        params = [view.focal, view.focal, *view.center]
        model.add_camera_with_trivial_rig(
            pycolmap.Camera(
                model="PINHOLE", width=view.width, height=view.height, params=params, camera_id=index
            )
        )
        keypoints = np.array(observed[index - 1], dtype=float).reshape(-1, 2)
        image = pycolmap.Image(name=photo.name, keypoints=keypoints, camera_id=index, image_id=index)
        rotation = view.camera_to_world.T
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ view.position)
        model.add_image_with_trivial_frame(image, pose)
    for track, point in zip(tracks, points, strict=True):
        model.add_point3D(point.position, track, point.color)
    model.update_point_3d_errors()
    model.write(folder)


def _corners(photo: Photo, count: int, rng: np.random.Generator) -> Float[np.ndarray, "P 2"]:
    """Pixel centres of the place, drawn in proportion to the photo's local contrast."""
    grey = photo.pixels.mean(axis=2)
    contrast = np.hypot(*np.gradient(grey)) + 1.5
    contrast[(photo.depth <= 0.0) | photo.visitor] = 0.0
    weights = contrast.ravel() / contrast.sum()
    count = min(count, int(np.count_nonzero(weights)))
    chosen = rng.choice(weights.size, size=count, replace=False, p=weights)
    return np.column_stack([chosen % grey.shape[1], chosen // grey.shape[1]]) + 0.5


def _visible(positions: Float[np.ndarray, "P 3"], photo: Photo) -> Bool[np.ndarray, " P"]:
    """Whether the photo sees the points: inside its frame, on its nearest surface, behind no visitor."""
    pixels, depth = photo.view.project(positions)
    inside = (depth > 0.1) & (pixels >= 1.0).all(axis=1)
    inside &= (pixels[:, 0] < photo.view.width - 1) & (pixels[:, 1] < photo.view.height - 1)
    column, row = np.where(inside[:, None], pixels, 0.0).astype(int).T
    surface = photo.depth[row, column]
    return inside & (np.abs(surface - depth) < _DEPTH_TOLERANCE * depth) & ~photo.visitor[row, column]


def _track(
    position: Float[np.ndarray, "3"],
    seen_by: Int[np.ndarray, " S"],
    photos: list[Photo],
    rng: np.random.Generator,
) -> SparsePoint:
    """The point with errors like those of real matches: about half a pixel in the photos, and as much in space."""
    if len(seen_by) > _LONGEST_TRACK:
        seen_by = np.sort(rng.choice(seen_by, size=_LONGEST_TRACK, replace=False))
    exact, size = [], []
    for index in seen_by:
        pixel, depth = photos[index].view.project(position[None])
        exact.append(pixel[0])
        size.append(depth[0] / photos[index].view.focal)
    pixels = np.array(exact) + rng.normal(0.0, 0.4, (len(exact), 2))
    moved = position + rng.normal(0.0, 0.4 * float(np.median(size)), 3)
    colors = [photos[i].pixels[int(p[1]), int(p[0])] for i, p in zip(seen_by, exact, strict=True)]
    color = np.mean(colors, axis=0).round().astype(np.uint8)
    return SparsePoint(
        np.round(moved / _METRE_STEP) * _METRE_STEP,
        color,
        seen_by,
        np.round(pixels / _PIXEL_STEP) * _PIXEL_STEP,
    )
