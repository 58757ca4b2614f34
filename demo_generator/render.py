"""Renders one view: linear radiance, depth, and the mask of visitors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from numba import parallel_chunksize

from demo_generator.cameras import Viewpoint
from demo_generator.lighting import Light
from demo_generator.render_kernels import (
    HAZE,
    depth_and_kind,
    heights_below,
    render_samples,
    smooth_indirect,
)
from demo_generator.sky_kernels import HORIZON
from demo_generator.solids import Solids, World


@dataclass(frozen=True)
class Rendered:
    """Buffers of one view.

    Attributes:
        radiance: Linear RGB.
        depth: Along the camera's axis at the pixels' centres, metres; 0 = sky.
        visitor: Whether any part of the pixel shows a visitor.
    """

    radiance: Float[np.ndarray, "H W 3"]
    depth: Float[np.ndarray, "H W"]
    visitor: Bool[np.ndarray, "H W"]


def render(
    place: World,
    visitors: World,
    lamps: Float[np.ndarray, "L 4"],
    light: Light,
    view: Viewpoint,
    *,
    per_pixel: int,
    seed: int,
) -> Rendered:
    """Renders a view.

    Args:
        place: What stays.
        visitors: What is there in this photo only.
        lamps: Position and strength of the evening lamps.
        light: Sun, sky and lamps of this photo.
        view: The camera.
        per_pixel: Samples per pixel along each axis.
        seed: Randomness of the light's sampling; equal seeds give equal grain where no visitor is.
    """
    camera = (
        view.position,
        np.ascontiguousarray(view.camera_to_world),
        view.focal,
        view.center,
        view.width,
        view.height,
    )
    vector = light.vector()
    # Rows differ in cost and cores may be busy: small portions keep all threads at work to the end.
    with parallel_chunksize(8):
        samples = render_samples(place.arrays, visitors.arrays, vector, lamps, *camera, per_pixel, seed)
        smooth = np.empty((*samples.shape[:2], 3), dtype=samples.dtype)
        for spacing in (1, 2, 4):
            smooth_indirect(samples, spacing, smooth)
            samples[..., :3] = smooth
            samples[..., 14] = 1.0
    radiance = samples[..., :3] * samples[..., 3:6] + samples[..., 6:9]
    distance = samples[..., 12:13]
    clear = np.where(distance > 0.0, np.exp(-distance / HAZE), 1.0)
    radiance = radiance * clear + vector[HORIZON : HORIZON + 3].astype(np.float32) * (1.0 - clear)
    depth, what = depth_and_kind(place.arrays, visitors.arrays, *camera)
    visitor = (_pool(samples[..., 13:14], per_pixel)[..., 0] > 0.0) | (what == 1)
    return Rendered(_pool(np.minimum(radiance, 8.0), per_pixel), depth, visitor)


def _pool(samples: Float[np.ndarray, "h w c"], per_pixel: int) -> Float[np.ndarray, "H W c"]:
    rows, columns, channels = samples.shape
    grid = samples.reshape(rows // per_pixel, per_pixel, columns // per_pixel, per_pixel, channels)
    return grid.mean(axis=(1, 3), dtype=np.float64)


def visible_share(landmark: World, around: World, view: Viewpoint) -> float:
    """Visible share of the landmark's area inside the picture.

    It is 0 where the landmark fills less than a sixth of the picture or comes nearer than 10 m.
    """
    small = (view.focal / 8.0, view.center / 8.0, view.width // 8, view.height // 8)
    camera = (view.position, np.ascontiguousarray(view.camera_to_world), *small)
    depth, what = depth_and_kind(landmark.arrays, Solids().build().arrays, *camera)
    alone = what == 0
    together = depth_and_kind(landmark.arrays, around.arrays, *camera)[1] == 0
    if alone.mean() < 1 / 6 or depth[alone].min() < 10.0:
        return 0.0
    return float(together.sum() / alone.sum())


def is_free(place: World, x: float, y: float, radius: float) -> bool:
    """Whether a disc on the ground is empty."""
    turns = np.linspace(0.0, 2.0 * np.pi, 9)
    points = np.column_stack([x + radius * np.cos(turns), y + radius * np.sin(turns)])
    points[-1] = x, y
    return bool(np.all(np.abs(heights_below(place.arrays, points, 2.4)) < 0.02))
