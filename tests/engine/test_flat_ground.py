"""Ground that few photos show, or that is known to be level: moved onto its plane, and nothing else is."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.engine.conftest import build_wall_scene
from tests.engine.test_photo_counts import differences_after_resuming
from wildgs.engine import flat_ground, photo_counts
from wildgs.engine.checkpoint import save_checkpoint
from wildgs.engine.config import FlatGroundConfig
from wildgs.engine.flat_ground import EVERY, HIGHEST_EYES, LEVEL_PULL, REACH, THINNEST, FlatGround
from wildgs.engine.report import StepReport
from wildgs.engine.trainer import TrainConfig, Trainer
from wildgs.geometry.camera import quats_to_rotations
from wildgs.model.config import DropoutConfig
from wildgs.model.method import Method
from wildgs.model.registry import MethodName, create_method
from wildgs.model.wildgs import WildGSConfig
from wildgs.scene import Scene

CONFIG = FlatGroundConfig(rate=0.05, photos=12, height=0.5, level=False)
LEVEL = replace(CONFIG, level=True, rate=0.3)
FEW = (1 - LEVEL.rate) ** EVERY
MANY = 1 - LEVEL_PULL * (1 - FEW)
"""Heights after a move, relative to those before, where few photos show Gaussians, and many on level ground."""
EYES = HIGHEST_EYES
"""The height that counts of cameras that are higher."""


def seen_from_above(scene: Scene, height: float = 1.0) -> Scene:
    """The wall as the ground z = 0, and cameras that look down on it from a height."""
    views = []
    for view in scene.views:
        viewmat = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
        viewmat[:3, 3] = view.camera.viewmat[:3, 3] + torch.tensor([0.0, 0.0, height])
        views.append(replace(view, camera=replace(view.camera, viewmat=viewmat)))
    return replace(scene, points=scene.points * torch.tensor([1.0, 1.0, 0.0]), views=tuple(views))


@pytest.fixture
def paving(wall_scene: Scene) -> Scene:
    return seen_from_above(wall_scene)


def method_for(scene: Scene, model: WildGSConfig, name: MethodName = "wildgs") -> Method:
    torch.manual_seed(0)
    return create_method(name, model if name == "wildgs" else None, scene)


def place(method: Method, places: list[tuple[float, float, float]], photos: list[float]) -> None:
    """Moves the first Gaussians to places, and sets the number of photos that show them (all others: many)."""
    with torch.no_grad():
        method.gaussians.means[: len(places)] = torch.tensor(places)
    counts = torch.full((len(method.gaussians),), 100.0)
    counts[: len(photos)] = torch.tensor(photos)
    method.gaussians.photos = counts


@pytest.mark.parametrize(("above", "counts"), [(0.08, 0.08), (3.0, HIGHEST_EYES)])
def test_what_is_moved_depends_on_the_height_of_the_cameras_up_to_a_limit(
    wall_scene: Scene, tiny_model: WildGSConfig, above: float, counts: float
) -> None:
    scene = seen_from_above(wall_scene, above)
    method = method_for(scene, tiny_model)
    place(method, [(0, 0, 0.45 * counts), (0, 0, 0.55 * counts)], [1, 1])
    FlatGround(method, scene, CONFIG).update(EVERY, 1)
    low, high = (method.gaussians.means[:2, 2] / counts).tolist()
    assert low < 0.4
    assert high == pytest.approx(0.55, rel=1e-4)


def test_only_what_few_photos_show_near_ground_and_cameras_moves(
    paving: Scene, tiny_model: WildGSConfig
) -> None:
    method = method_for(paving, tiny_model)
    far = 1.0 + 2 * REACH
    low, high, deep = 0.4 * EYES, 0.6 * EYES, 0.9 * EYES
    places = [
        (0, 0, low),
        (0, 0, -low),
        (0, 0, low),
        (0, 0, low),
        (0, 0, high),
        (0, 0, -deep),
        (0, 0, -1.1 * EYES),
        (far, 0, low),
        (1e9, 0, low),
    ]
    place(method, places, [1, 3, 7.5, 12, 1, 1, 1, 1, 1])
    before = {name: row.detach().clone() for name, row in method.gaussians.rows.items()}
    FlatGround(method, paving, CONFIG).update(EVERY, 1)
    stays = (1 - CONFIG.rate) ** EVERY
    half = 1 - (1 - stays) / 2
    heights = method.gaussians.means[: len(places), 2].tolist()
    expected = [low * stays, -low * stays, low * half, low, high, -deep * stays, -1.1 * EYES, low, low]
    assert heights == pytest.approx(expected, abs=1e-4)
    assert torch.equal(method.gaussians.means[:, :2], before["means"][:, :2])
    assert torch.equal(method.gaussians.means[len(places) :], before["means"][len(places) :])
    for name in before.keys() - {"means", "log_scales"}:
        assert torch.equal(method.gaussians.rows[name], before[name]), name


def with_steps(wall_scene: Scene, height: float) -> Scene:
    """Right of x = 0.3, sparse points are at a height of a step, relative to that of the cameras."""
    scene = seen_from_above(wall_scene, EYES)
    points = scene.points.clone()
    points[points[:, 0] > 0.3, 2] = height * EYES
    return replace(scene, points=points)


@pytest.mark.parametrize(
    ("height", "moves"), [(0.0, True), (0.02, True), (0.2, False), (0.6, False), (-0.2, False), (1.5, True)]
)
def test_what_many_photos_show_moves_where_the_nearest_sparse_points_are_on_the_plane(
    wall_scene: Scene, tiny_model: WildGSConfig, height: float, moves: bool
) -> None:
    scene, low = with_steps(wall_scene, height), 0.4 * EYES
    method = method_for(scene, tiny_model)
    ground = FlatGround(method, scene, LEVEL)
    place(method, [(-0.5, 0, low), (0.7, 0, low), (0.7, 0, low)], [100, 100, 1])
    ground.update(EVERY, 1)
    heights = (method.gaussians.means[:3, 2] / low).tolist()
    # A wall of points above the eyes says nothing about what is below them: the nearest others do.
    assert heights == pytest.approx([MANY, MANY if moves else 1.0, FEW], abs=0.05)


def test_level_ground_is_flat_before_photos_are_counted(wall_scene: Scene, tiny_model: WildGSConfig) -> None:
    scene, low = with_steps(wall_scene, 0.2), 0.4 * EYES
    method = method_for(scene, tiny_model)
    place(method, [(-0.5, 0, low), (0.7, 0, low)], [100, 1])
    method.gaussians.photos = None
    FlatGround(method, scene, LEVEL).update(EVERY, 1)
    heights = (method.gaussians.means[:2, 2] / low).tolist()
    assert heights == pytest.approx([MANY, 1.0], abs=0.05)


@pytest.mark.parametrize("known", [0, 2, 20])
def test_ground_of_depth_maps_alone_is_not_known_to_be_level(
    paving: Scene, tiny_model: WildGSConfig, monkeypatch: pytest.MonkeyPatch, known: int
) -> None:
    """The few sparse points are a step, if there are any."""
    steps = paving.points[:known] + torch.tensor([0.0, 0.0, 0.2 * EYES])
    scene = replace(paving, points=steps, point_colors=paving.point_colors[:known])
    dense = (paving.points, torch.zeros(len(paving.points), 3, dtype=torch.uint8))
    monkeypatch.setattr(flat_ground, "depth_points", lambda *_: dense)
    method, low = method_for(paving, tiny_model), 0.4 * EYES
    ground = FlatGround(method, scene, LEVEL)
    assert ground.is_used
    place(method, [(0, 0, low), (0, 0, low)], [100, 1])
    ground.update(EVERY, 1)
    heights = (method.gaussians.means[:2, 2] / low).tolist()
    assert heights == pytest.approx([1.0, FEW], abs=0.05)


def test_the_ground_of_depth_maps_counts_where_sfm_found_none(
    paving: Scene, tiny_model: WildGSConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = replace(paving, points=paving.points[:20], point_colors=paving.point_colors[:20])
    method = method_for(paving, tiny_model)
    assert not FlatGround(method, scene, CONFIG).is_used
    dense = (paving.points, torch.zeros(len(paving.points), 3, dtype=torch.uint8))
    monkeypatch.setattr(flat_ground, "depth_points", lambda *_: dense)
    ground = FlatGround(method, scene, CONFIG)
    place(method, [(0, 0, 0.4 * EYES)], [1])
    ground.update(EVERY, 1)
    stays = (1 - CONFIG.rate) ** EVERY
    assert method.gaussians.means[0, 2].item() == pytest.approx(0.4 * EYES * stays, rel=1e-3)


def test_a_camera_far_away_changes_nothing_for_the_others(paving: Scene, tiny_model: WildGSConfig) -> None:
    stray = paving.views[0]
    viewmat = stray.camera.viewmat.clone()
    viewmat[0, 3] -= 1e5
    stray = replace(stray, camera=replace(stray.camera, viewmat=viewmat))
    scene = replace(paving, views=(stray, *paving.views[1:]))
    method = method_for(scene, tiny_model)
    place(method, [(0, 0, 0.4 * EYES), (1.0 + 2 * REACH, 0, 0.4 * EYES)], [1, 1])
    FlatGround(method, scene, CONFIG).update(EVERY, 1)
    near, far = (method.gaussians.means[:2, 2] / EYES).tolist()
    assert near == pytest.approx(0.4 * (1 - CONFIG.rate) ** EVERY, rel=1e-3)
    assert far == pytest.approx(0.4, rel=1e-3)


def test_it_happens_at_fixed_steps_however_many_are_taken_at_once(
    paving: Scene, tiny_model: WildGSConfig
) -> None:
    method = method_for(paving, tiny_model)
    ground = FlatGround(method, paving, CONFIG)
    ground.update(EVERY, 1)  # photos are not counted yet
    place(method, [(0, 0, 0.05)], [1])
    for step in range(1, EVERY):
        ground.update(step, 1)
    assert method.gaussians.means[0, 2].item() == pytest.approx(0.05)
    ground.update(4 * EVERY, 4 * EVERY)
    assert method.gaussians.means[0, 2].item() == pytest.approx(
        0.05 * (1 - CONFIG.rate) ** (4 * EVERY), rel=1e-3
    )


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_in_the_end_they_are_flat_whatever_their_rotation(seed: int) -> None:
    scene = seen_from_above(build_wall_scene())
    method = create_method("3dgs", None, scene)
    method.flattens_ground = True
    generator = torch.Generator().manual_seed(seed)
    count = 50
    with torch.no_grad():
        rows = method.gaussians.rows
        rows["means"][:count] = torch.rand(count, 3, generator=generator) * torch.tensor([0.5, 0.5, 0.05])
        rows["quats"][:count] = torch.randn(count, 4, generator=generator)
        rows["log_scales"][:count] = torch.randn(count, 3, generator=generator) - 3
    before = rows["log_scales"][:count].exp().clone()
    method.gaussians.photos = torch.ones(len(method.gaussians))
    FlatGround(method, scene, replace(CONFIG, rate=1.0)).update(EVERY, 1)
    scales = rows["log_scales"][:count].exp()
    axes = quats_to_rotations(rows["quats"][:count])
    thin = axes[:, 2].abs().argmax(dim=1, keepdim=True)
    thickness = scales.gather(1, thin)[:, 0]
    wide = (scales.sum(dim=1) - thickness) / 2
    torch.testing.assert_close(rows["means"][:count, 2], torch.zeros(count), atol=1e-5, rtol=0)
    assert bool((thickness <= THINNEST * wide * 1.001).all())
    kept = torch.ones_like(before, dtype=torch.bool).scatter(1, thin, False)
    assert torch.equal(scales[kept], before[kept])
    assert bool((scales <= before * 1.001).all())


def test_an_upright_needle_stays_finite(paving: Scene, tiny_model: WildGSConfig) -> None:
    method = method_for(paving, tiny_model)
    place(method, [(0, 0, 0.01)], [1])
    with torch.no_grad():
        method.gaussians.rows["quats"][0] = torch.tensor([1.0, 0.0, 0.0, 0.0])
        method.gaussians.rows["log_scales"][0] = torch.tensor([-30.0, -40.0, -3.0])
    FlatGround(method, paving, replace(CONFIG, rate=1.0)).update(EVERY, 1)
    scales = method.gaussians.rows["log_scales"][0].detach()
    assert scales[:2].tolist() == [-30.0, -40.0]
    assert scales[2].item() == pytest.approx(-30.0 + math.log(THINNEST / 2), abs=1e-3)


def test_without_level_ground_nothing_is_used(wall_scene: Scene, tiny_model: WildGSConfig) -> None:
    method = method_for(wall_scene, tiny_model)
    assert not FlatGround(method, wall_scene, CONFIG).is_used  # the cameras are below its only plane
    place(method, [(0, 0, 0.9)], [1])
    before = method.gaussians.means.detach().clone()
    FlatGround(method, wall_scene, CONFIG).update(EVERY, 1)
    assert torch.equal(method.gaussians.means, before)


@pytest.mark.parametrize("name", ["3dgs", "affine"])
def test_other_methods_keep_their_ground(paving: Scene, tiny_model: WildGSConfig, name: MethodName) -> None:
    assert not FlatGround(method_for(paving, tiny_model, name), paving, CONFIG).is_used


def test_it_can_be_switched_off(paving: Scene, tiny_model: WildGSConfig) -> None:
    assert not FlatGround(method_for(paving, tiny_model), paving, replace(CONFIG, rate=0.0)).is_used


def trainer_for(scene: Scene, model: WildGSConfig, rate: float = 0.05, steps: int = 24) -> Trainer:
    config = TrainConfig(
        steps=steps,
        precision="float32",
        dropout=DropoutConfig(rate=0.0),
        flat_ground=replace(CONFIG, rate=rate),
    )
    return Trainer(method_for(scene, model), scene, config)


def test_training_counts_photos_for_it_and_a_resumed_run_ends_in_the_same_bits(
    paving: Scene, tiny_model: WildGSConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(photo_counts, "LEAST_INTERVAL", 10)
    whole = trainer_for(paving, tiny_model)

    def save(report: StepReport) -> None:
        if report.step == 15:
            save_checkpoint(tmp_path, 15, whole.state(), {})

    whole.run([save])
    assert whole.photo_counts.dropout_rates() is None
    assert differences_after_resuming(whole, tmp_path, paving, tiny_model) == []


def test_the_ground_is_flatter_with_it(
    paving: Scene, tiny_model: WildGSConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(photo_counts, "LEAST_INTERVAL", 10)
    spread = []
    for rate in (0.0, 0.05):
        trainer = trainer_for(paving, tiny_model, rate, steps=30)
        trainer.run()
        heights = trainer.method.gaussians.means[:, 2].detach()
        spread.append(float(heights[heights.abs() < 0.5].abs().mean()))
    assert spread[1] < 0.7 * spread[0]
