"""Frames have the shape that the photos have."""

from __future__ import annotations

import pytest
import torch

from tests.memory_views import make_view
from wildgs.geometry.camera import Camera
from wildgs.scene import View
from wildgs.scene.trajectories import usual_size


def view(width: int, height: int) -> View:
    return make_view("photo.jpg", Camera(torch.eye(4), torch.eye(3), width, height))


LYING, STANDING = view(41, 30), view(31, 44)


@pytest.mark.parametrize(
    ("views", "size"),
    [
        ([LYING, LYING, STANDING], (40, 30)),
        ([LYING, STANDING, STANDING], (44, 30)[::-1]),
        ([LYING, STANDING], (42, 30)),
        ([LYING] * 2 + [STANDING] * 3, (44, 30)),
        ([view(20, 20)], (20, 20)),
    ],
)
def test_frames_lie_unless_most_photos_stand(views: list[View], size: tuple[int, int]) -> None:
    assert usual_size(views) == size
