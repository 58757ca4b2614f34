"""Cameras: projecting undoes unprojecting."""

from __future__ import annotations

import torch

from wildgs.geometry.camera import Camera


def test_projecting_undoes_unprojecting() -> None:
    torch.manual_seed(0)
    rotation, _ = torch.linalg.qr(torch.randn(3, 3))
    viewmat = torch.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = rotation * rotation.det(), torch.tensor([0.3, -0.2, 0.5])
    K = torch.tensor([[50.0, 0, 17.0], [0, 40.0, 9.0], [0, 0, 1]])
    camera = Camera(viewmat, K, 30, 20)
    depth = 1 + torch.rand(20, 30)
    pixels, depths = camera.project(camera.unproject(depth).reshape(-1, 3))
    rows, columns = torch.meshgrid(torch.arange(20.0), torch.arange(30.0), indexing="ij")
    torch.testing.assert_close(depths.reshape(20, 30), depth, atol=1e-5, rtol=0)
    torch.testing.assert_close(pixels[:, 0].reshape(20, 30), columns + 0.5, atol=1e-3, rtol=0)
    torch.testing.assert_close(pixels[:, 1].reshape(20, 30), rows + 0.5, atol=1e-3, rtol=0)
