"""Densification as 3DGS does it, with the optimiser's state carried along."""

from __future__ import annotations

import math

import pytest
import torch

from wildgs.engine.config import DensityConfig
from wildgs.engine.density import ClassicDensity, DensityControl, SeenView
from wildgs.engine.optimizers import OptimizerConfig, Optimizers
from wildgs.model.gaussians import Gaussians
from wildgs.model.vanilla import VanillaConfig, VanillaGS

EXTENT = 1.0


@pytest.fixture
def method() -> VanillaGS:
    """Four Gaussians: small, large, faint, and one that does nothing."""
    torch.manual_seed(0)
    method = VanillaGS.from_points(VanillaConfig(), torch.randn(4, 3), torch.zeros(4, 3, dtype=torch.uint8))
    with torch.no_grad():
        method.gaussians.rows["log_scales"].copy_(torch.tensor([0.005, 0.05, 0.005, 0.005]).log()[:, None])
        method.gaussians.rows["opacity_logits"].copy_(torch.tensor([0.9, 0.9, 0.001, 0.9]).logit())
    return method


def controlled(
    method: VanillaGS, gradients: list[float], **config: float
) -> tuple[DensityControl, Optimizers]:
    optimizers = Optimizers.build(method, OptimizerConfig(), EXTENT)
    for parameter in method.gaussians.parameters():
        parameter.grad = torch.ones_like(parameter)
    optimizers.step()
    control = ClassicDensity(DensityConfig(**config), EXTENT, len(method.gaussians))  # type: ignore[arg-type]
    control.demand = torch.tensor(gradients) * 3
    control.seen = torch.full((4,), 3.0)
    return control, optimizers


def round_of(control: DensityControl, method: VanillaGS, optimizers: Optimizers, large: bool = False):
    generator = torch.Generator().manual_seed(0)
    return control.densify(method.gaussians, optimizers.rows, generator, prune_large=large)


def test_what_may_not_grow_leaves_the_budget_to_others(method: VanillaGS) -> None:
    control, optimizers = controlled(method, [1e-2, 1e-2, 0.0, 1e-3], max_gaussians=5, prune_opacity=0.0)
    means = method.gaussians.means.detach().clone()
    report = control.densify(
        method.gaussians,
        optimizers.rows,
        torch.Generator().manual_seed(0),
        prune_large=False,
        growable=torch.tensor([False, False, True, True]),
    )
    assert (report.cloned, report.split, report.pruned) == (1, 0, 0)
    assert torch.equal(method.gaussians.means.detach(), means[[0, 1, 2, 3, 3]])


def test_small_clones_large_splits_faint_goes(method: VanillaGS) -> None:
    means = method.gaussians.means.detach().clone()
    control, optimizers = controlled(method, [1e-3, 1e-3, 1e-3, 0.0])
    means = method.gaussians.means.detach().clone()
    report = round_of(control, method, optimizers)
    assert (report.cloned, report.split, report.pruned) == (1, 1, 1)
    gaussians = method.gaussians
    assert len(gaussians) == 5
    assert torch.equal(gaussians.means[:3].detach(), means[[0, 3, 0]])
    halves = gaussians.scales[3:].detach()
    torch.testing.assert_close(halves, torch.full((2, 3), 0.05 / 1.6), rtol=0.1, atol=0)
    assert (gaussians.means[3:].detach() - means[1]).norm(dim=1).max() < 5 * 0.05
    assert len(control.demand) == len(control.seen) == 5


def test_moments_follow_and_newcomers_start_at_rest(method: VanillaGS) -> None:
    control, optimizers = controlled(method, [1e-3, 1e-3, 0.0, 0.0])
    round_of(control, method, optimizers)
    for rows in method.gaussians.rows.values():
        state = optimizers.rows.state[rows]["exp_avg"]
        assert state.shape == rows.shape
        assert (state[:2] != 0).all()
        assert (state[2:] == 0).all()


def test_below_the_threshold_nothing_grows(method: VanillaGS) -> None:
    control, optimizers = controlled(method, [1e-4, 1.9e-4, 0.0, 0.0])
    report = round_of(control, method, optimizers)
    assert (report.cloned, report.split) == (0, 0)


def test_budget_goes_to_the_steepest(method: VanillaGS) -> None:
    control, optimizers = controlled(method, [1e-3, 5e-3, 0.0, 2e-3], max_gaussians=5)
    report = round_of(control, method, optimizers)
    assert (report.cloned, report.split) == (0, 1)


def test_oversized_and_broken_gaussians_go(method: VanillaGS) -> None:
    control, optimizers = controlled(method, [0.0] * 4)
    with torch.no_grad():
        method.gaussians.rows["log_scales"][1] = 0.0
        method.gaussians.rows["means"][3, 0] = float("nan")
    assert round_of(control, method, optimizers, large=True).pruned == 3
    assert len(method.gaussians) == 1


def test_what_fills_the_picture_goes_once_opacities_were_reset(method: VanillaGS) -> None:
    control, optimizers = controlled(method, [0.0] * 4)
    control.largest = torch.tensor([0.1, 0.2, 0.0, 0.1])
    assert round_of(control, method, optimizers).pruned == 1, "the faint one"
    control.largest = torch.tensor([0.1, 0.2, 0.1])
    assert round_of(control, method, optimizers, large=True).pruned == 1
    assert control.largest.tolist() == [0.0, 0.0]


def test_pruning_by_reach_can_be_switched_off(method: VanillaGS) -> None:
    control, optimizers = controlled(method, [0.0] * 4, prune_reach=0.0)
    control.largest = torch.tensor([0.1, 0.9, 0.0, 0.1])
    assert round_of(control, method, optimizers, large=True).pruned == 1, "the faint one"


def test_what_is_far_may_be_large_unless_switched_off(method: VanillaGS) -> None:
    with torch.no_grad():
        method.gaussians.rows["means"][0] = torch.tensor([100 * EXTENT, 0, 0])
        method.gaussians.rows["log_scales"][0] = math.log(2 * EXTENT)
    for by_distance, pruned in ((True, 1), (False, 2)):
        copy = VanillaGS(
            method.config, Gaussians({n: v.detach().clone() for n, v in method.gaussians.rows.items()})
        )
        control, optimizers = controlled(copy, [0.0] * 4, prune_by_distance=by_distance)
        assert round_of(control, copy, optimizers, large=True).pruned == pruned


def test_a_scene_is_never_pruned_to_nothing(method: VanillaGS) -> None:
    control, optimizers = controlled(method, [0.0] * 4)
    with torch.no_grad():
        method.gaussians.rows["opacity_logits"].fill_(-20.0)
    round_of(control, method, optimizers)
    assert len(method.gaussians) == 4


def test_reset_lowers_opacities_and_forgets_their_moments(method: VanillaGS) -> None:
    control, optimizers = controlled(method, [0.0] * 4)
    before = method.gaussians.opacities.detach().clone()
    control.reset_opacity(method.gaussians, optimizers.rows)
    torch.testing.assert_close(method.gaussians.opacities.detach(), before.clamp(max=0.01))
    state = optimizers.rows.state[method.gaussians.rows["opacity_logits"]]
    assert state["exp_avg"].abs().sum() == 0


def test_reset_leaves_alone_what_no_photo_has_shown(method: VanillaGS) -> None:
    control, optimizers = controlled(method, [0.0] * 4)
    optimizers.rows.state[method.gaussians.means]["exp_avg_sq"][1] = 0
    before = method.gaussians.opacities.detach().clone()
    assert before[1] > 0.01
    control.reset_opacity(method.gaussians, optimizers.rows)
    lowered = before.clamp(max=0.01)
    lowered[1] = before[1]
    torch.testing.assert_close(method.gaussians.opacities.detach(), lowered)
    control = ClassicDensity(DensityConfig(reset_unseen=True), EXTENT, 4)
    control.reset_opacity(method.gaussians, optimizers.rows)
    torch.testing.assert_close(method.gaussians.opacities.detach(), before.clamp(max=0.01))


def test_screen_gradient_is_per_half_picture(method: VanillaGS) -> None:
    """As 3DGS: the threshold means the same at any resolution."""
    from wildgs.geometry.camera import Camera

    control = ClassicDensity(DensityConfig(), EXTENT, 4)
    K = torch.tensor([[50.0, 0, 32], [0, 50.0, 16], [0, 0, 1]])
    viewmat = torch.eye(4)
    viewmat[2, 3] = 6.0
    projection = method.gaussians.project(Camera(viewmat, K, 64, 32))
    projection.means2d.retain_grad()
    (projection.means2d * torch.tensor([3.0, 4.0])).sum().backward()
    blank = torch.zeros(32, 64, 3)
    control.gather(SeenView(projection, blank, torch.zeros(4, 3), blank))
    expected = torch.where(projection.visible, torch.tensor([3.0 * 32, 4.0 * 16]).norm(), 0.0)
    torch.testing.assert_close(control.demand, expected)
    assert torch.equal(control.seen, projection.visible.float())
    torch.testing.assert_close(control.largest, projection.radii / 64)


def test_restored_statistics_are_where_the_gaussians_are() -> None:
    """A resumed run may densify before a step has gathered anything."""
    control = ClassicDensity(DensityConfig(), 1.0, 5, "meta")
    control.restore(ClassicDensity(DensityConfig(), 1.0, 5).state())
    assert {value.device.type for value in control.state().values()} == {"meta"}


def test_what_may_not_grow_is_neither_pruned_nor_reset(method: VanillaGS) -> None:
    control, optimizers = controlled(method, [0.0] * 4, prune_opacity=2.0)
    means, before = method.gaussians.means.detach().clone(), method.gaussians.opacities.detach().clone()
    growable = torch.tensor([True, False, True, False])
    control.reset_opacity(method.gaussians, optimizers.rows, growable)
    expected = torch.where(growable, before.clamp(max=0.01), before)
    torch.testing.assert_close(method.gaussians.opacities.detach(), expected)
    generator = torch.Generator().manual_seed(0)
    control.densify(method.gaussians, optimizers.rows, generator, prune_large=True, growable=growable)
    assert torch.equal(method.gaussians.means.detach(), means[[1, 3]])
