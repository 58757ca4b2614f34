"""Gaussians move from where they show nothing to where renders are wrong."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from wildgs.engine.config import DensityConfig, OptimizerConfig
from wildgs.engine.density import RelocationDensity, SeenView
from wildgs.engine.optimizers import Optimizers
from wildgs.geometry.camera import Camera
from wildgs.model.vanilla import VanillaConfig, VanillaGS
from wildgs.rasterize import blend

SIDE = 32
CONFIG = DensityConfig(max_gaussians=8, grow_share=0.25, prune_share=0.25, grow_error=0.0)


@pytest.fixture
def method() -> VanillaGS:
    """Five Gaussians in a plane before the camera: one a corner, and one behind the first."""
    means = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [-1, 1, 0], [1, 1, 0], [-1.25, -1.25, 1]])
    method = VanillaGS.from_points(VanillaConfig(), means, torch.full((5, 3), 128, dtype=torch.uint8))
    with torch.no_grad():
        method.gaussians.rows["log_scales"].copy_(torch.tensor([0.3, 0.2, 0.2]).log().expand(5, 3))
        method.gaussians.rows["opacity_logits"].fill_(0.99).logit_()
    return method


def camera() -> Camera:
    viewmat = torch.eye(4)
    viewmat[2, 3] = 4.0
    return Camera(viewmat, torch.tensor([[32.0, 0, SIDE / 2], [0, 32, SIDE / 2], [0, 0, 1]]), SIDE, SIDE)


def view_of(method: VanillaGS, wrong: tuple[slice, slice], error: float = 0.5) -> SeenView:
    """A photo that is what the method renders, but in one part."""
    projection = method.gaussians.project(camera())
    painted = torch.full((len(method.gaussians), 3), 0.2, requires_grad=True)
    colors = blend(projection, painted).colors
    photo = colors.detach().clone()
    photo[wrong] += error
    return RelocationDensity(CONFIG, 1.0, 5).before_backward(SeenView(projection, colors, painted, photo))


UPPER_LEFT, LOWER_RIGHT = (slice(0, 16), slice(0, 16)), (slice(16, 32), slice(16, 32))


def round_of(control: RelocationDensity, method: VanillaGS, **further: torch.Tensor):
    optimizers = Optimizers.build(method, OptimizerConfig(), 1.0)
    for parameter in method.gaussians.parameters():
        parameter.grad = torch.ones_like(parameter)
    optimizers.step()
    generator = torch.Generator().manual_seed(0)
    return control.densify(method.gaussians, optimizers.rows, generator, prune_large=False, **further)


def test_what_a_view_says(method: VanillaGS) -> None:
    """Error is counted where a Gaussian shows, by how much it shows there."""
    control = RelocationDensity(CONFIG, 1.0, 5)
    found = control.measure(view_of(method, UPPER_LEFT))
    assert found.demand[0] > 3 * found.demand[4] > 0  # hidden behind the first
    assert not found.demand[1:4].any()
    weight = torch.autograd.functional.jacobian(
        lambda values: blend(method.gaussians.project(camera()), values[:, None]).colors.sum(), torch.ones(5)
    )
    torch.testing.assert_close(found.largest, weight)
    torch.testing.assert_close(found.demand[0], 0.5 * weight[0], rtol=1e-3, atol=0)
    skipped = control.measure(view_of(method, UPPER_LEFT), torch.tensor(False))
    assert not torch.cat([skipped.demand, skipped.seen, skipped.largest]).any()


def test_pixels_that_do_not_count_are_no_error(method: VanillaGS) -> None:
    view = view_of(method, UPPER_LEFT)
    counts = torch.ones(SIDE, SIDE, dtype=torch.bool)
    counts[UPPER_LEFT] = False
    control = RelocationDensity(CONFIG, 1.0, 5)
    assert not control.measure(control.before_backward(replace(view, counts=counts))).demand.any()


def test_the_wrong_one_splits_along_its_longest_axis(method: VanillaGS) -> None:
    control = RelocationDensity(CONFIG, 1.0, 5)
    control.gather(view_of(method, LOWER_RIGHT))
    report = round_of(control, method)
    assert (report.split, report.pruned) == (1, 0)
    assert len(method.gaussians) == 6
    halves = method.gaussians.means.detach()[-2:]
    moved = method.gaussians.scales.detach()
    torch.testing.assert_close(halves.mean(dim=0), torch.tensor([1.0, 1, 0]), atol=1e-2, rtol=0)
    assert (halves[0] - halves[1]).abs().argmax() == 0
    assert moved[-1, 0] == pytest.approx(0.65 * 0.3, rel=0.02)
    assert moved[-1, 1] == pytest.approx(0.9 * 0.2, rel=0.02)


def test_what_shows_nothing_makes_room(method: VanillaGS) -> None:
    """At a full budget, one goes for one that splits, once two views have not shown it."""
    control = RelocationDensity(replace(CONFIG, max_gaussians=5, least_pixels=10.0), 1.0, 5)
    control.gather(view_of(method, LOWER_RIGHT))
    assert round_of(control, method).pruned == 0
    for _ in range(2):
        control.gather(view_of(method, LOWER_RIGHT))
    report = round_of(control, method)
    assert (report.split, report.pruned, len(method.gaussians)) == (1, 1, 5)
    assert not (method.gaussians.means[:, 2] > 0.5).any()  # the hidden one went


def test_small_errors_split_nothing_and_what_may_not_grow_stays(method: VanillaGS) -> None:
    control = RelocationDensity(replace(CONFIG, grow_error=1e3), 1.0, 5)
    control.gather(view_of(method, LOWER_RIGHT))
    assert round_of(control, method).split == 0
    control = RelocationDensity(replace(CONFIG, least_pixels=1e6), 1.0, 5)
    for _ in range(2):
        control.gather(view_of(method, LOWER_RIGHT))
    means = method.gaussians.means.detach().clone()
    report = round_of(control, method, growable=torch.zeros(5, dtype=torch.bool))
    assert (report.split, report.pruned) == (0, 0)
    torch.testing.assert_close(method.gaussians.means.detach(), means, atol=1e-2, rtol=0)


def test_what_is_known_moves_with_the_gaussians_and_through_a_checkpoint(method: VanillaGS) -> None:
    control = RelocationDensity(CONFIG, 1.0, 5)
    control.gather(view_of(method, LOWER_RIGHT))
    before = control.largest.clone()
    round_of(control, method)
    torch.testing.assert_close(control.largest, torch.cat([0.8 * before[[0, 1, 2, 4]], torch.zeros(2)]))
    assert control.known.tolist() == [1, 1, 1, 1, 0, 0]
    control.gather(view_of(method, LOWER_RIGHT))
    other = RelocationDensity(CONFIG, 1.0, 0)
    other.restore(control.state())
    assert {name: value.tolist() for name, value in other.state().items()} == {
        name: value.tolist() for name, value in control.state().items()
    }


@pytest.mark.parametrize(("grow", "prune"), [(0.4, 0.2), (0.2, 0.4)])
def test_shares_that_grow_and_that_are_pruned_are_limited_separately(
    grow: float, prune: float, method: VanillaGS
) -> None:
    """A budget that is not spent fills up faster than Gaussians are replaced."""
    config = replace(CONFIG, grow_share=grow, prune_share=prune, least_pixels=1e6)
    control = RelocationDensity(config, 1.0, 5)
    for _ in range(2):
        control.gather(view_of(method, (slice(0, SIDE), slice(0, SIDE))))
    report = round_of(control, method)
    assert (report.split, report.pruned) == (round(5 * grow), round(5 * prune))
