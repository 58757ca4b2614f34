"""The direction of the sun, from photos of a tower on a plane that were shaded by known suns."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from wildgs.geometry.camera import Camera
from wildgs.light.shadows import SunFinder
from wildgs.model.gaussians import Gaussians
from wildgs.rasterize import rasterize


def _tower() -> tuple[Gaussians, torch.Tensor]:
    """Balls on the faces of a tower of 1 x 1 x 2 on a plane of 6 x 6; and their normals."""
    line = np.arange(-0.5, 0.51, 0.1)
    parts = [(np.array([x, y, 0.0]), (0, 0, 1)) for x in np.arange(-3, 3, 0.1) for y in np.arange(-3, 3, 0.1)]
    for height in np.arange(0, 2, 0.1):
        for along in line:
            for sign in (-1, 1):
                parts.append((np.array([sign * 0.5, along, height]), (sign, 0, 0)))
                parts.append((np.array([along, sign * 0.5, height]), (0, sign, 0)))
    parts += [(np.array([x, y, 2.0]), (0, 0, 1)) for x in line for y in line]
    means = torch.tensor(np.array([place for place, _ in parts])).float()
    count = len(means)
    rows = {
        "means": means,
        "quats": torch.eye(4)[:1].repeat(count, 1),
        "log_scales": torch.full((count, 3), 0.06).log(),
        "opacity_logits": torch.full((count,), 3.0),
    }
    return Gaussians(rows), torch.tensor([normal for _, normal in parts]).float()


def _lit(means: torch.Tensor, normals: torch.Tensor, sun: torch.Tensor) -> torch.Tensor:
    """Brightness by an analytic ray against the tower's box."""
    origin = means + 0.02 * normals + 1e-4
    near, far = torch.zeros(len(means)), torch.full((len(means),), torch.inf)
    for axis, (low, high) in enumerate([(-0.5, 0.5), (-0.5, 0.5), (0.0, 2.0)]):
        ends = (torch.tensor([low, high]) - origin[:, axis, None]) / sun[axis]
        near, far = torch.maximum(near, ends.amin(dim=1)), torch.minimum(far, ends.amax(dim=1))
    free = far <= near
    return 0.25 + 0.5 * free * (normals @ sun).clamp_min(0)


def _camera(azimuth: float) -> Camera:
    eye = torch.tensor([7 * np.cos(azimuth), 7 * np.sin(azimuth), 3.0]).float()
    forward = torch.nn.functional.normalize(torch.tensor([0.0, 0.0, 0.7]) - eye, dim=0)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, torch.tensor([0.0, 0.0, 1.0])), dim=0)
    rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
    viewmat = torch.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ eye
    return Camera(viewmat, torch.tensor([[150.0, 0, 80], [0, 150, 60], [0, 0, 1]]), 160, 120)


@torch.no_grad()
@pytest.mark.parametrize(("elevation", "azimuth"), [(20, 40), (50, 160), (30, 290)])
def test_the_sun_is_found_by_its_shadows(elevation: float, azimuth: float) -> None:
    gaussians, normals = _tower()
    height, turn = np.radians([elevation, azimuth])
    sun = torch.tensor([np.cos(height) * np.cos(turn), np.cos(height) * np.sin(turn), np.sin(height)]).float()
    finder = SunFinder(gaussians, None, torch.arange(len(normals)), torch.zeros(len(normals), 1, 3))
    camera = _camera(1.3 + turn)
    brightness = _lit(gaussians.means, normals, sun)[:, None].repeat(1, 3) ** (1 / 2.2)
    values = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities)
    photo = 0.8 * rasterize(*values, brightness, camera).colors  # another exposure
    found = finder.direction(photo, camera)
    angle = np.degrees(np.arccos(float(torch.nn.functional.normalize(found, dim=0) @ sun)))
    assert angle < 25  # the grid has steps of 8 and 20 degrees
    assert found.norm() > 0.7
    assert finder.direction(photo, camera, [torch.zeros(8, 8)])[:2].norm() < 1e-3
