"""The photo with whose view a scene opens."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from wildgs.geometry.camera import Camera
from wildgs.scene import Alignment, Scene, View
from wildgs.scene.photo_store import Photo, PhotoStore
from wildgs.scene.start import choose_start


class _NoPhotos(PhotoStore):
    """Only cameras and points decide."""

    def get(self, name: str) -> Photo:
        pytest.fail(f"{name} is read")


POINTS = torch.rand(400, 3, generator=torch.Generator().manual_seed(0)) * 2 - 1


def _camera(distance: float, sideways: float = 0.0) -> Camera:
    viewmat = torch.eye(4)
    viewmat[:3, 3] = torch.tensor([-sideways, 0.0, distance])
    return Camera(viewmat, torch.tensor([[40.0, 0, 32], [0, 40, 24], [0, 0, 1]]), 64, 48)


def _scene(
    cameras: list[Camera], points: torch.Tensor = POINTS, observed: list[torch.Tensor] | None = None
) -> Scene:
    views = tuple(
        View(f"{number}.jpg", camera, "train", _NoPhotos()) for number, camera in enumerate(cameras)
    )
    pairs = [
        torch.stack([torch.full_like(rows, number), rows], dim=1)
        for number, rows in enumerate(observed or [])
    ]
    colors = torch.zeros(len(points), 3, dtype=torch.uint8)
    observations = torch.cat(pairs).int() if pairs else torch.zeros(0, 2, dtype=torch.int32)
    return Scene(Path(), views, points, colors, Alignment.identity(), observations)


def test_neither_too_near_nor_too_far_nor_looking_past_it() -> None:
    cameras = [_camera(12.0), _camera(1.2), _camera(3.0), _camera(3.0, 5.0), _camera(-3.0)]
    view, depth = choose_start(_scene(cameras))
    assert view.name == "2.jpg"
    assert depth == pytest.approx(3.0, abs=0.3)


def test_a_landmark_that_is_cut_off_goes_behind_one_that_is_whole() -> None:
    assert choose_start(_scene([_camera(3.0, 1.9), _camera(3.0)]))[0].name == "1.jpg"
    assert choose_start(_scene([_camera(2.0), _camera(2.6)]))[0].name == "1.jpg"


def test_a_view_that_others_share_goes_before_a_closer_one_of_its_own() -> None:
    """Frames of a drone's video see much, at great detail, that no other photo sees."""
    common, rare = torch.arange(0, 150), torch.arange(150, 400)
    cameras = [_camera(2.6), *(_camera(3.2 + 0.1 * number) for number in range(6))]
    assert choose_start(_scene(cameras))[0].name == "0.jpg"
    observed = [rare[:60], *[common] * 6]
    assert choose_start(_scene(cameras, observed=observed))[0].name == "1.jpg"


def test_a_photo_that_matches_little_is_not_where_a_scene_opens() -> None:
    """A blurred photo, and one in which visitors stand before the landmark, observe few of the points."""
    rows = torch.arange(len(POINTS))
    cameras = [_camera(3.0), _camera(3.0), _camera(3.0)]
    assert choose_start(_scene(cameras, observed=[rows[::20], rows, rows[::3]]))[0].name == "1.jpg"


def test_observations_are_those_of_the_photo_where_some_are_held_out() -> None:
    rows = torch.arange(len(POINTS))
    scene = _scene([_camera(3.0)] * 3, observed=[rows, rows[::20], rows])
    first = replace(scene.views[0], split="test")
    held_out = replace(scene, views=(first, *scene.views[1:]))
    assert choose_start(held_out)[0].name == "2.jpg"


def test_a_scene_without_points_still_opens() -> None:
    view, depth = choose_start(_scene([_camera(3.0)], torch.zeros(0, 3)))
    assert (view.name, depth) == ("0.jpg", 1.0)


def test_a_scene_that_only_has_held_out_photos_opens_with_one() -> None:
    scene = _scene([_camera(3.0)])
    view = replace(scene.views[0], split="test")
    assert choose_start(replace(scene, views=(view,)))[0] is view
