"""Cameras: projecting undoes unprojecting, and a centred camera looks through the centre of its image."""

from __future__ import annotations

import pytest
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


@pytest.mark.parametrize("principal", [(200.0, 150.0), (310.0, 40.0), (5.0, 290.0)])
def test_a_centred_camera_looks_through_the_centre_of_the_image(principal: tuple[float, float]) -> None:
    torch.manual_seed(1)
    rotation, _ = torch.linalg.qr(torch.randn(3, 3, dtype=torch.double))
    viewmat = torch.eye(4, dtype=torch.double)
    viewmat[:3, :3], viewmat[:3, 3] = rotation * rotation.det(), torch.tensor([0.3, -0.2, 0.5])
    K = torch.tensor([[300.0, 0, principal[0]], [0, 280.0, principal[1]], [0, 0, 1]]).double()
    camera = Camera(viewmat, K, 400, 300)
    centered = camera.centered()
    ray = torch.linalg.inv(K) @ torch.tensor([200.0, 150.0, 1.0]).double()
    ahead = torch.nn.functional.normalize(camera.viewmat[:3, :3].T @ ray, dim=0)
    torch.testing.assert_close(centered.forward, ahead)
    torch.testing.assert_close(centered.position, camera.position)
    assert centered.K[:2, 2].tolist() == [200.0, 150.0]
    turned = centered.viewmat[:3, :3]
    torch.testing.assert_close(turned @ turned.T, torch.eye(3).double())
    assert float(turned.det()) > 0
    if principal == (200.0, 150.0):
        torch.testing.assert_close(centered.viewmat, camera.viewmat)
    # It does not roll: the axis between the two directions is perpendicular to both.
    axis = torch.linalg.cross(camera.forward, ahead)
    torch.testing.assert_close(turned @ axis, camera.viewmat[:3, :3] @ axis)
