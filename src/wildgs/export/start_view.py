"""Where a scene is first seen from: a photo's viewpoint that shows the landmark whole."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from wildgs.geometry.camera import Camera

_MIDDLE = 0.3
"""Half size of the picture's middle part, whose points say how far away the landmark is."""


def choose_start(cameras: Sequence[Camera], points: Float[Tensor, "P 3"]) -> tuple[int, float]:
    """The camera that shows most of the scene, as large as it fits, and the distance of what it looks at.

    Args:
        cameras: Of the training photos, at least one.
        points: SfM points in the same frame.

    Returns:
        Index of the camera, and the depth of the landmark before it in world units.
    """
    scores = torch.tensor([_score(camera, points) for camera in cameras])
    best = int(scores.argmax())
    return best, _depth(cameras[best], points)


def _project(camera: Camera, points: Float[Tensor, "P 3"]) -> tuple[Tensor, Tensor]:
    """Places in the picture (0 to 1 on each axis) and depths of the points before the camera."""
    pixels, depths = camera.project(points)
    before = depths > 1e-3
    return pixels[before] / torch.tensor([camera.width, camera.height]).to(points), depths[before]


def _score(camera: Camera, points: Float[Tensor, "P 3"]) -> float:
    """Share of the points that the picture shows, times the share of the picture over which most of them spread.

    The first falls when the camera stands too near, the second when it stands too far.
    """
    places, _ = _project(camera, points)
    inside = places[((places >= 0) & (places <= 1)).all(dim=1)]
    if len(inside) < 2:
        return 0.0
    spread = inside.quantile(0.95, dim=0) - inside.quantile(0.05, dim=0)
    return len(inside) / len(points) * float(spread.prod().sqrt())


def _depth(camera: Camera, points: Float[Tensor, "P 3"]) -> float:
    """Median depth of the points in the picture's middle."""
    places, depths = _project(camera, points)
    middle = ((places - 0.5).abs() < _MIDDLE).all(dim=1)
    chosen = depths[middle] if bool(middle.any()) else depths
    return float(chosen.median()) if len(chosen) else 1.0
