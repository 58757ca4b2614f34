"""The first Gaussians: within their budget, and the ground's discs flat, opaque and overlapping."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from wildgs.errors import WildGSWarning
from wildgs.geometry.camera import Camera
from wildgs.model.config import InitialConfig, SkyConfig
from wildgs.model.encoder import load_encoder
from wildgs.model.gaussians import Gaussians
from wildgs.model.initial import (
    InitialBudget,
    ground_rows,
    initial_from_points,
    initial_gaussians,
)
from wildgs.model.parsing import ParsingConfig
from wildgs.model.registry import METHODS, method_type
from wildgs.model.wildgs import WildGS, WildGSConfig
from wildgs.priors.config import GroundConfig
from wildgs.priors.ground import GroundPoints
from wildgs.rasterize import blend
from wildgs.scene import Alignment, Scene, View, load_scene


def grid(spacing: float) -> torch.Tensor:
    x, y = torch.meshgrid(torch.arange(-1, 1, spacing), torch.arange(-1, 1, spacing), indexing="ij")
    return torch.stack([x, y, torch.zeros_like(x)], dim=-1).reshape(-1, 3)


def test_who_stands_on_it_sees_no_hole() -> None:
    """A camera 0.2 above the ground that looks down at it: all is covered, at the right depth."""
    gaussians = Gaussians(ground_rows(grid(0.04), torch.full((len(grid(0.04)),), 0.04)))
    tilt = torch.tensor(0.6)
    forward = torch.stack([torch.zeros(()), tilt.cos(), -tilt.sin()])
    right = torch.tensor([1.0, 0.0, 0.0])
    viewmat = torch.eye(4)
    viewmat[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward])
    viewmat[:3, 3] = -viewmat[:3, :3] @ torch.tensor([0.0, -0.5, 0.2])
    K = torch.tensor([[60.0, 0, 32], [0, 60.0, 32], [0, 0, 1]])
    camera = Camera(viewmat, K, 64, 64)
    with torch.no_grad():
        seen = blend(gaussians.project(camera), None)
    lower = slice(34, 62)
    assert float(seen.alpha[lower].min()) > 0.8
    places = camera.unproject(seen.depth)[lower]
    assert float(places[..., 2].abs().mean()) < 0.02


def test_models_have_it_where_it_is_given() -> None:
    torch.manual_seed(0)
    points, colors = torch.rand(30, 3), torch.randint(0, 256, (30, 3), dtype=torch.uint8)
    config = WildGSConfig(parsing=ParsingConfig(max_side=32), sky=SkyConfig(points=0))
    ground = GroundPoints(grid(0.5), torch.full((16, 3), 200, dtype=torch.uint8), torch.full((16,), 0.5))
    initial = initial_from_points(WildGS.initial(config), points, colors, ground=ground)
    model = WildGS.create(config, initial, load_encoder(None))
    assert len(model.gaussians) == 30 + 16
    assert torch.equal(model.gaussians.means[30:].detach(), ground.points)
    sh0 = model.fusion.initial_intrinsic(torch.full((1, 3), 200 / 255))[0, :3]
    torch.testing.assert_close(model.gaussians.rows["intrinsic"][30:, :3].detach(), sh0.expand(16, 3))


def bare_scene(points: int) -> Scene:
    generator = torch.Generator().manual_seed(0)
    places = torch.rand(points, 3, generator=generator)
    return Scene(Path("bare"), (), places, torch.zeros(points, 3, dtype=torch.uint8), Alignment.identity())


def paved_scene(view: View) -> Scene:
    """Paving at z = -0.5 with a gap, and cameras at a height of 0.05 above the gap that look along +y."""
    generator = torch.Generator().manual_seed(0)
    places = 4 * torch.rand(4000, 2, generator=generator) - 2
    places = places[places.norm(dim=1) > 0.6]
    points = torch.cat([places, torch.full((len(places), 1), -0.5)], dim=1)
    turn = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    K, views = torch.tensor([[100.0, 0.0, 50.0], [0.0, 100.0, 40.0], [0.0, 0.0, 1.0]]), []
    for number in range(3):
        viewmat = torch.eye(4)
        viewmat[:3, :3] = turn
        viewmat[:3, 3] = -turn @ torch.tensor([0.2 * number, -0.3, -0.45])
        views.append(replace(view, name=f"{number}.jpg", camera=Camera(viewmat, K, 100, 80)))
    colors = torch.zeros(len(points), 3, dtype=torch.uint8)
    return Scene(Path("paved"), tuple(views), points, colors, Alignment.identity())


def test_the_ground_is_where_sfm_has_it_and_denser_where_photos_are_near(
    make_scene: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Points of depth maps, of which there are more, lie 0.02 lower."""
    scene = paved_scene(load_scene(make_scene(3)).train_views[0])
    lower = scene.points.repeat(3, 1) - torch.tensor([0.0, 0.0, 0.02])
    dense = lower, torch.zeros(len(lower), 3, dtype=torch.uint8)
    monkeypatch.setattr("wildgs.model.initial.depth_points", lambda *_: dense)
    config = InitialConfig(sky=SkyConfig(points=0))
    initial = initial_gaussians(scene, config, 3_000_000)
    ground = slice(len(scene.points) + len(lower), None)
    heights, scales = initial.rows["means"][ground, 2], initial.rows["log_scales"][ground].exp()
    torch.testing.assert_close(heights, torch.full_like(heights, -0.5), atol=1e-4, rtol=0)
    torch.testing.assert_close(scales[:, 2], scales[:, 0] / 6, rtol=1e-4, atol=0)
    assert float(scales[:, 0].max()) >= 4 * float(scales[:, 0].min())
    even = initial_gaussians(scene, replace(config, ground=GroundConfig(most_pixels=0.0)), 3_000_000)
    assert float(even.rows["log_scales"][ground, 0].std()) < 1e-5
    assert len(even.colors) < len(initial.colors)


@settings(deadline=None, max_examples=200)
@given(
    budget=st.integers(1, 100_000),
    found=st.integers(1, 200_000),
    sky=st.integers(0, 10_000),
    dense=st.integers(0, 50_000),
    ground=st.integers(0, 20_000),
)
def test_the_shares_of_a_budget_stay_within_it(
    budget: int, found: int, sky: int, dense: int, ground: int
) -> None:
    shares = InitialBudget(budget)
    taken = [shares.sky(sky)]
    taken.append(shares.sfm(found, taken[0]))
    taken.append(shares.further(dense, sum(taken)))
    taken.append(shares.further(ground, sum(taken)))
    assert min(taken) >= 0
    assert taken[1] >= 1
    assert sum(taken) <= budget
    assert sum(taken) < budget or budget <= 2, "room for densification stays"


@pytest.mark.filterwarnings("ignore::wildgs.errors.WildGSWarning")
@settings(deadline=None, max_examples=20)
@given(budget=st.integers(1, 3000), method=st.sampled_from(sorted(METHODS)))
def test_no_method_starts_with_more_gaussians_than_its_budget(budget: int, method: str) -> None:
    kind = method_type(method)
    config = kind.initial(kind.Config())
    initial = initial_gaussians(bare_scene(2000), config, budget)
    assert 1 <= len(initial.colors) <= budget
    assert all(len(values) == len(initial.colors) for values in initial.rows.values())


def test_a_budget_that_suffices_changes_nothing() -> None:
    scene = bare_scene(500)
    config = InitialConfig(sky=SkyConfig(points=100))
    enough, plenty = (initial_gaussians(scene, config, budget) for budget in (2000, 3_000_000))
    assert len(enough.colors) == 600
    assert all(torch.equal(enough.rows[name], values) for name, values in plenty.rows.items())


def test_points_beyond_the_budget_are_thinned_with_a_warning() -> None:
    with pytest.warns(WildGSWarning, match=r"500 points; training starts from 75 of them"):
        initial = initial_gaussians(bare_scene(500), InitialConfig.sfm_only(), 100)
    assert len(initial.points) == len(initial.colors) == 75
