"""viser's cameras and ours are the same cameras."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from wildgs.geometry.camera import Camera, quats_to_rotations
from wildgs.viewer.cameras import camera_of, fov_that_holds, pose_of


def camera() -> Camera:
    viewmat = torch.eye(4)
    viewmat[:3, :3] = quats_to_rotations(torch.tensor([[0.4, -0.2, 0.7, 0.1]]))[0]
    viewmat[:3, 3] = torch.tensor([0.3, -0.8, 2.0])
    return Camera(viewmat, torch.tensor([[50.0, 0, 32], [0, 50.0, 24], [0, 0, 1]]), 64, 48)


def test_there_and_back() -> None:
    back = camera_of(pose_of(camera()), 48)
    torch.testing.assert_close(back.viewmat, camera().viewmat, atol=1e-6, rtol=0)
    torch.testing.assert_close(back.K, camera().K, atol=1e-4, rtol=0)
    assert (back.width, back.height) == (64, 48)


def test_other_size_has_the_same_view() -> None:
    large = camera_of(pose_of(camera()), 96)
    torch.testing.assert_close(large.K, camera().resized(128, 96).K, atol=1e-4, rtol=0)


@pytest.mark.parametrize("aspect", [0.5, 4 / 3, 2.5])
def test_whole_photo_is_in_the_window(aspect: float) -> None:
    pose = pose_of(camera())
    vertical = fov_that_holds(pose, aspect)
    horizontal = 2 * math.atan(math.tan(vertical / 2) * aspect)
    assert vertical >= pose.fov - 1e-9
    assert horizontal >= 2 * math.atan(32 / 50) - 1e-9
    assert vertical == pytest.approx(pose.fov) or horizontal == pytest.approx(2 * math.atan(32 / 50))


def test_half_turn() -> None:
    """A rotation by 180 degrees, where quaternions from matrices go wrong."""
    turned = replace(camera(), viewmat=torch.diag(torch.tensor([-1.0, -1.0, 1.0, 1.0])))
    torch.testing.assert_close(camera_of(pose_of(turned), 48).viewmat, turned.viewmat, atol=1e-6, rtol=0)
