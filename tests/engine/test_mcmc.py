"""3DGS-MCMC: relocation that preserves the render, noise, penalties."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from wildgs.engine.config import DensityConfig, OptimizerConfig
from wildgs.engine.density import McmcDensity
from wildgs.engine.density.mcmc import MOST_COPIES, shared_opacity
from wildgs.engine.optimizers import Optimizers
from wildgs.geometry.camera import Camera
from wildgs.model.vanilla import VanillaConfig, VanillaGS
from wildgs.rasterize import blend

SIDE = 32


def five(opacity: float = 0.8) -> VanillaGS:
    """Five Gaussians in a row before the camera, of which the last is transparent."""
    torch.manual_seed(0)
    means = torch.stack([torch.linspace(-2, 2, 5), torch.zeros(5), torch.zeros(5)], dim=1)
    method = VanillaGS.from_points(VanillaConfig(), means, torch.full((5, 3), 200, dtype=torch.uint8))
    with torch.no_grad():
        method.gaussians.rows["log_scales"].copy_(torch.tensor([0.3, 0.2, 0.1]).log().expand(5, 3))
        method.gaussians.rows["quats"].copy_(torch.randn(5, 4))
        method.gaussians.rows["opacity_logits"].copy_(torch.tensor([opacity] * 4 + [0.004]).logit())
    return method


def control(budget: int = 5, **options: float) -> McmcDensity:
    return McmcDensity(DensityConfig(max_gaussians=budget, **options), 1.0, 5)


def rounds(density: McmcDensity, method: VanillaGS, count: int = 1, **further: torch.Tensor):
    optimizers = Optimizers.build(method, OptimizerConfig(), 1.0)
    for parameter in method.gaussians.parameters():
        parameter.grad = torch.ones_like(parameter)
    optimizers.step()
    generator = torch.Generator().manual_seed(0)
    reports = [
        density.densify(method.gaussians, optimizers.rows, generator, prune_large=False, **further)
        for _ in range(count)
    ]
    return optimizers, reports


def picture(method: VanillaGS) -> torch.Tensor:
    view = torch.eye(4)
    view[2, 3] = 5.0
    K = torch.tensor([[30.0, 0, SIDE / 2], [0, 30.0, SIDE / 2], [0, 0, 1]])
    with torch.no_grad():
        colors = torch.zeros(len(method.gaussians), 3)
        return blend(method.gaussians.project(Camera(view, K, SIDE, SIDE)), colors).alpha


def test_a_transparent_gaussian_moves_to_another() -> None:
    method = five()
    before = method.gaussians.means.detach().clone()
    _, (report,) = rounds(control(), method)
    assert (report.cloned, report.split, report.pruned) == (1, 0, 1)
    means = method.gaussians.means.detach()
    assert len(means) == 5
    distances = torch.cdist(means, before)
    assert float(distances.min(dim=1).values.max()) < 1e-3, "no new place"
    places = distances.argmin(dim=1)
    assert 4 not in places
    assert len(places.unique()) == 4
    pair = (places == places.mode().values).nonzero()[:, 0]
    opacities = method.gaussians.opacities[pair]
    torch.testing.assert_close(1 - (1 - opacities).prod(), torch.tensor(0.8), atol=2e-2, rtol=0)


def test_the_number_grows_by_a_twentieth_up_to_the_budget() -> None:
    method = five()
    with torch.no_grad():
        for rows in method.gaussians.rows.values():
            rows.data = rows.data[:4].repeat(25, *[1] * (rows.dim() - 1))
    density = McmcDensity(DensityConfig(max_gaussians=108), 1.0, 100)
    _, reports = rounds(density, method, 3)
    assert [report.cloned for report in reports] == [5, 3, 0]
    assert len(method.gaussians) == 108


def test_the_render_hardly_changes() -> None:
    method = five()
    before = picture(method)
    _, (report,) = rounds(control(budget=40), method, 1)
    assert report.cloned >= 1
    after = picture(method)
    assert float(before.max()) > 0.7
    assert float((after - before).abs().max()) < 0.08


def test_gaussians_that_may_not_grow_stay() -> None:
    method = five()
    growable = torch.tensor([False, True, True, True, False])
    before = {name: rows.detach().clone() for name, rows in method.gaussians.rows.items()}
    rounds(control(budget=50), method, growable=growable)
    for index in (0, 4):
        # The Adam step of `rounds` moved all of them by less than this.
        distance = (method.gaussians.means - before["means"][index]).norm(dim=1)
        (found,) = (distance < 0.01).nonzero()[:, 0].tolist()
        torch.testing.assert_close(
            method.gaussians.rows["log_scales"][found], before["log_scales"][index], atol=0.02, rtol=0
        )


def test_without_any_opaque_gaussian_nothing_happens() -> None:
    method = five(opacity=0.001)
    _, (report,) = rounds(control(), method)
    assert (report.cloned, report.pruned) == (0, 0)
    assert len(method.gaussians) == 5


def test_noise_moves_transparent_gaussians_along_their_shape() -> None:
    method = five(opacity=0.9)
    with torch.no_grad():
        method.gaussians.rows["quats"].copy_(torch.tensor([1.0, 0, 0, 0]).expand(5, 4))
    before = method.gaussians.means.detach().clone()
    density, generator = control(noise_lr=1.0), torch.Generator().manual_seed(0)
    moves = []
    for _ in range(400):
        density.perturb(method.gaussians, 0.5, generator)
        moves.append(method.gaussians.means.detach() - before)
        with torch.no_grad():
            method.gaussians.means.copy_(before)
    spread = torch.stack(moves).std(dim=0)
    assert float(spread[:4].max()) < 1e-6, "opaque ones stay"
    amount = 0.5 / (1 + math.exp(100 * (0.004 - 0.005)))
    expected = amount * torch.tensor([0.3, 0.2, 0.1]).square()
    torch.testing.assert_close(spread[4], expected, rtol=0.15, atol=0)
    density.perturb(method.gaussians, 0.5, generator, torch.zeros(5, dtype=torch.bool))
    assert torch.equal(method.gaussians.means, before)


def test_the_penalty_is_the_weighted_mean_of_opacity_and_scale() -> None:
    method = five()
    density = control(opacity_reg=0.1, scale_reg=10.0)
    growable = torch.tensor([True, False, False, False, False])
    assert density.regularizer(method.gaussians, growable).item() == pytest.approx(0.1 * 0.8 + 10 * 0.2)
    assert density.regularizer(method.gaussians, ~growable | growable).item() == pytest.approx(
        0.1 * (4 * 0.8 + 0.004) / 5 + 10 * 0.2, rel=1e-4
    )
    assert density.regularizer(method.gaussians, torch.zeros(5, dtype=torch.bool)).item() == 0


@settings(deadline=None)
@given(opacity=st.floats(0.01, 0.999), number=st.integers(1, MOST_COPIES + 10))
def test_shares_follow_the_double_sum_of_the_paper(opacity: float, number: int) -> None:
    new, factor = shared_opacity(torch.tensor([opacity]), torch.tensor([number]))
    limited = min(number, MOST_COPIES)
    expected = 1 - (1 - opacity) ** (1 / limited)
    assert new.item() == pytest.approx(expected, rel=1e-3, abs=1e-6)
    divisor = sum(
        math.comb(i - 1, k) * (-1) ** k * expected ** (k + 1) / math.sqrt(k + 1)
        for i in range(1, limited + 1)
        for k in range(i)
    )
    assert factor.item() == pytest.approx(opacity / divisor, rel=1e-3)


def test_one_gaussian_that_shares_with_nobody_stays_as_it_is() -> None:
    opacities = torch.tensor([0.1, 0.5, 1.0])
    new, factors = shared_opacity(opacities, torch.ones(3, dtype=torch.int64))
    torch.testing.assert_close(new, opacities, atol=2e-6, rtol=0)
    torch.testing.assert_close(factors, torch.ones(3))
