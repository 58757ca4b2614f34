"""The page opens where the landmark is seen whole."""

from __future__ import annotations

import pytest
import torch

from wildgs.export.start_view import choose_start
from wildgs.geometry.camera import Camera


def _camera(distance: float, sideways: float = 0.0) -> Camera:
    viewmat = torch.eye(4)
    viewmat[:3, 3] = torch.tensor([-sideways, 0.0, distance])
    return Camera(viewmat, torch.tensor([[40.0, 0, 32], [0, 40, 24], [0, 0, 1]]), 64, 48)


def test_neither_too_near_nor_too_far_nor_looking_past_it() -> None:
    points = torch.rand(400, 3, generator=torch.Generator().manual_seed(0)) * 2 - 1
    cameras = [_camera(12.0), _camera(1.2), _camera(3.0), _camera(3.0, 5.0), _camera(-3.0)]
    index, depth = choose_start(cameras, points)
    assert index == 2
    assert depth == pytest.approx(3.0, abs=0.3)


def test_a_scene_without_points_still_opens() -> None:
    assert choose_start([_camera(3.0)], torch.zeros(0, 3)) == (0, 1.0)
