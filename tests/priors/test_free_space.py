"""A sloping wall seen by seven photos; a coach stands before it in one of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from tests.memory_views import make_view, with_photos
from wildgs.errors import UserError
from wildgs.geometry.camera import Camera
from wildgs.priors.free_space import find_foregrounds
from wildgs.scene import Alignment, Scene, View

SIDE, PHOTOS = 64, 7
COACH = (slice(30, 56), slice(20, 44))


def camera(index: int) -> Camera:
    viewmat = torch.eye(4)
    viewmat[0, 3] = 0.1 * (index - PHOTOS // 2)
    K = torch.tensor([[60.0, 0, SIDE / 2], [0, 60.0, SIDE / 2], [0, 0, 1]])
    return Camera(viewmat, K, SIDE, SIDE)


def wall() -> torch.Tensor:
    return torch.linspace(3, 2, SIDE)[:, None].expand(SIDE, SIDE).clone()


def view(index: int, depth: torch.Tensor | None, metric: torch.Tensor | None = None) -> View:
    photo = torch.full((SIDE, SIDE, 3), 10 * index, dtype=torch.uint8)
    disparity = None if depth is None else (0.3 + 0.02 * index) / depth + 0.01 * index
    made = make_view(f"{index}.png", camera(index), "train", photo, disparity=disparity)
    return made if metric is None else with_photos(made, depth=metric.numpy())


def scene(depths: list[torch.Tensor | None]) -> Scene:
    return scene_of([view(index, depth) for index, depth in enumerate(depths)])


def scene_of(views: list[View]) -> Scene:
    known = camera(PHOTOS // 2).unproject(wall())[::3, ::3].reshape(-1, 3)
    colors = torch.zeros(len(known), 3, dtype=torch.uint8)
    return Scene(Path("wall"), tuple(views), known, colors, Alignment.identity())


def with_coach(depth: float = 1.0) -> torch.Tensor:
    covered = wall()
    covered[COACH] = depth
    return covered


def found(scene: Scene) -> dict[str, torch.Tensor]:
    return find_foregrounds(scene, lambda done, total: None)


def test_what_one_photo_shows_before_what_the_others_see_is_in_free_space() -> None:
    maps = found(scene([with_coach() if index == 3 else wall() for index in range(PHOTOS)]))
    coach = torch.zeros(SIDE, SIDE, dtype=torch.bool)
    coach[COACH] = True
    assert maps["3.png"][coach].mean() > 0.95
    assert not maps["3.png"][~coach].any()
    assert not any(maps[f"{index}.png"].any() for index in range(PHOTOS) if index != 3)


def test_what_all_photos_show_is_not() -> None:
    assert found(scene([wall()] * PHOTOS)) == {}
    kiosk = []  # the same place in all photos
    for index in range(PHOTOS):
        depth, left = wall(), 26 + round(6.0 * (index - PHOTOS // 2))
        depth[30:56, left : left + 12] = 1.0
        kiosk.append(depth)
    for degrees in found(scene(kiosk)).values():
        assert degrees.mean() < 0.01, "rounding at its sides apart"


@pytest.mark.parametrize("depth", [1.95, 3.5])
def test_what_is_hardly_nearer_or_behind_is_not(depth: float) -> None:
    maps = found(scene([with_coach(depth) if index == 3 else wall() for index in range(PHOTOS)]))
    assert not maps or not maps["3.png"].any()


def test_one_photo_alone_proves_nothing() -> None:
    assert found(scene([with_coach(), wall()])) == {}


def test_a_photo_that_is_nearly_all_in_free_space_has_a_wrong_depth_map() -> None:
    near = wall()
    near[:, :58] = 0.8
    near[::3, ::3] = wall()[::3, ::3]  # where it is aligned
    assert found(scene([near if index == 3 else wall() for index in range(PHOTOS)])) == {}


def test_photos_without_a_prior_have_no_foreground_but_are_no_obstacle() -> None:
    depths = [with_coach() if index == 3 else None if index == 1 else wall() for index in range(PHOTOS)]
    maps = found(scene(depths))
    assert not maps["1.png"].any()
    assert maps["3.png"].any()
    assert found(scene([None] * PHOTOS)) == {}


def test_without_sparse_points_nothing_can_be_aligned() -> None:
    made = scene([with_coach() if index == 3 else wall() for index in range(PHOTOS)])
    assert found(replace(made, points=made.points[:0], point_colors=made.point_colors[:0])) == {}


def test_metric_depth_on_which_photos_agreed_is_static() -> None:
    views = [view(index, with_coach() if index == 3 else wall()) for index in range(PHOTOS)]
    views[3] = view(3, with_coach(), metric=with_coach())
    assert found(scene_of(views)) == {}


def test_photos_that_cannot_be_read_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    made = scene([with_coach() if index == 3 else wall() for index in range(PHOTOS)])
    broken, read = made.views[0], View.read_disparity

    def failing(self: View) -> torch.Tensor | None:
        if self.name == broken.name:
            raise UserError("gone")
        return read(self)

    monkeypatch.setattr(View, "read_disparity", failing)
    maps = found(made)
    assert broken.name not in maps
    assert maps["3.png"].any()


def test_larger_photos_have_maps_of_at_most_120_pixels() -> None:
    def enlarged(made: View, depth: torch.Tensor) -> View:
        large = torch.nn.functional.interpolate(depth[None, None], scale_factor=4)[0, 0]
        photo = torch.zeros(*large.shape, 3, dtype=torch.uint8)
        return make_view(
            made.name, made.camera.resized(4 * SIDE, 4 * SIDE), "train", photo, disparity=0.3 / large
        )

    depths = [with_coach() if index == 3 else wall() for index in range(PHOTOS)]
    views = [enlarged(view(index, depth), depth) for index, depth in enumerate(depths)]
    maps = found(scene_of(views))
    assert max(maps["3.png"].shape) <= 120
    rows, columns = (maps["3.png"] > 0.5).nonzero().float().mean(dim=0) / maps["3.png"].shape[0]
    assert float(rows) == pytest.approx(43 / SIDE, abs=0.02)
    assert float(columns) == pytest.approx(32 / SIDE, abs=0.02)
