"""Checks that metric depth is in the units of the model that it belongs to."""

from __future__ import annotations

import torch

from wildgs.errors import UserError
from wildgs.scene.scene import Scene, View

_PHOTOS, _LEAST_POINTS = 20, 10
_MOST = 1.25
"""Factor by which metric depth and the points of a model may differ over all photos."""


def refuse_other_units(scene: Scene) -> None:
    """Compares metric depth with the points that photos observe: Gaussians begin, and are held, where it says.

    Raises:
        UserError: It is of a model that was replaced since, or in metres where the model is not.
    """
    if next((scene.root / "depth").rglob("*.tiff"), None) is None:
        return
    train = [(row, view) for row, view in enumerate(scene.views) if view.split == "train"]
    chosen = train[:: max(1, len(train) // _PHOTOS)]
    ratios = [ratio for row, view in chosen if (ratio := _ratio(scene, row, view)) is not None]
    if not ratios:
        return
    usual = float(torch.tensor(ratios).median())
    if not 1 / _MOST <= usual <= _MOST:
        raise UserError(
            f"{scene.root / 'depth'}: metric depth (.tiff) is {usual:.3g} times as large as that of the model's "
            f"points, so it is in other units or of another model: divide it by {usual:.3g}, or delete these files "
            "and run `wildgs depth --by stereo`"
        )


def _ratio(scene: Scene, row: int, view: View) -> float | None:
    """Median of metric depth over the depth of points; None where too few points have both."""
    depth = view.read_depth()
    if depth is None:
        return None
    observed = scene.observations[:, 0] == row
    pixels, z = view.camera.project(scene.points[scene.observations[observed, 1].long()])
    size = torch.tensor([view.camera.width, view.camera.height])
    inside = (z > 0) & ((pixels >= 0) & (pixels < size)).all(dim=1)
    x, y = pixels[inside].long().unbind(dim=1)
    found, z = depth[y, x], z[inside]
    known = found > 0
    return float((found[known] / z[known]).median()) if int(known.sum()) >= _LEAST_POINTS else None
