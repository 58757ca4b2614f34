"""Baked Gaussians keep their picture in another frame."""

from __future__ import annotations

import torch

from wildgs.exporters.splats import Splats
from wildgs.geometry.camera import Camera, quats_to_rotations
from wildgs.rasterize import rasterize
from wildgs.scene import Alignment


def _picture(splats: Splats, camera: Camera) -> torch.Tensor:
    values = (splats.means, splats.quats, splats.scales, splats.opacities, splats.sh)
    return rasterize(*(value.double() for value in values), camera, sh_degree=3, backend="reference").colors


def test_the_input_frame_shows_the_same_picture(splats: Splats) -> None:
    rotation = quats_to_rotations(torch.tensor([[0.3, -0.8, 0.1, 0.5]], dtype=torch.float64))[0]
    alignment = Alignment(rotation, torch.tensor([3.0, -1.0, 2.0], dtype=torch.float64), 0.4)
    K = torch.tensor([[30.0, 0, 16], [0, 30, 12], [0, 0, 1]], dtype=torch.float64)
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[2, 3] = 6.0
    aligned = Camera(viewmat, K, 32, 24)
    placed = splats.to_input_frame(alignment)
    seen = _picture(placed, alignment.inverse().apply_camera(aligned))
    torch.testing.assert_close(seen, _picture(splats, aligned), atol=1e-4, rtol=0)
    torch.testing.assert_close(alignment.apply_points(placed.means), splats.means, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(placed.scales, splats.scales / 0.4)
