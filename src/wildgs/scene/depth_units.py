"""Checks that metric depth maps are in the units of the COLMAP model."""

from __future__ import annotations

import torch

from wildgs.errors import UserError
from wildgs.scene.scene import Scene, View

_PHOTOS, _LEAST_POINTS = 20, 10
_MOST = 1.25
"""Largest median ratio between metric depth and the depth of the model's points."""


def refuse_other_units(scene: Scene) -> None:
    """Compares metric depth with the depth of the points that photos observe.

    Raises:
        UserError: The depth maps were made for another model, or have other units.
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
            f"{scene.root / 'depth'}: metric depth (.tiff) is {usual:.3g} times the depth of the model's points; "
            f"it has other units or belongs to another model: divide it by {usual:.3g}, or delete these files and "
            "run `wildgs depth --by stereo`"
        )


def _ratio(scene: Scene, row: int, view: View) -> float | None:
    """Median ratio of metric depth to the depth of points; None if too few points have both."""
    depth = view.read_depth()
    if depth is None:
        return None
    observed = scene.observations[:, 0] == row
    pixels, z = view.camera.project(scene.points[scene.observations[observed, 1].long()])
    size = torch.tensor([view.camera.width, view.camera.height])
    inside = (z > 0) & ((pixels >= 0) & (pixels < size)).all(dim=1)
    x, y = pixels[inside].long().unbind(dim=1)
    found, z = depth[y, x], z[inside]
    valid = found > 0
    return float((found[valid] / z[valid]).median()) if int(valid.sum()) >= _LEAST_POINTS else None
