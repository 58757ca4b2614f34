"""Row edits keep parameters and Adam's state together."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from wildgs.engine import optimizers as optimizers_module
from wildgs.engine.optimizers import (
    OptimizerConfig,
    Optimizers,
    edit_rows,
    geometry_rates,
    reset_moments,
)
from wildgs.model.vanilla import VanillaConfig, VanillaGS


def trained_baseline(count: int = 12) -> tuple[VanillaGS, Optimizers]:
    """A baseline after one step whose moments tell every row apart."""
    torch.manual_seed(0)
    method = VanillaGS.from_points(
        VanillaConfig(), torch.randn(count, 3), torch.zeros(count, 3, dtype=torch.uint8)
    )
    optimizers = Optimizers.build(method, OptimizerConfig(), extent=2.0)
    for parameter in method.gaussians.parameters():
        numbers = torch.arange(1.0, count + 1).reshape(-1, *[1] * (parameter.dim() - 1))
        parameter.grad = numbers.expand_as(parameter).clone()
    optimizers.step()
    return method, optimizers


def moments(method: VanillaGS, optimizers: Optimizers, name: str) -> torch.Tensor:
    return optimizers.rows.state[method.gaussians.rows[name]]["exp_avg"]


@given(st.lists(st.booleans(), min_size=12, max_size=12), st.integers(0, 5))
@settings(max_examples=20, deadline=None)
def test_rows_and_moments_stay_aligned(kept: list[bool], added: int) -> None:
    method, optimizers = trained_baseline()
    gaussians, keep = method.gaussians, torch.tensor(kept)
    before = {name: rows.detach().clone() for name, rows in gaussians.rows.items()}
    old_moments = {name: moments(method, optimizers, name).clone() for name in before}
    new = {name: torch.randn(added, *rows.shape[1:]) for name, rows in before.items()}
    gaussians.photos = torch.arange(12.0)
    edit_rows(gaussians, optimizers.rows, keep, new | {"photos": torch.full((added,), 50.0)})
    assert gaussians.photos.tolist() == [n for n in range(12) if kept[n]] + [50.0] * added
    for name in before:
        expected = torch.cat([before[name][keep], new[name]])
        assert torch.equal(gaussians.rows[name].detach(), expected)
        state = moments(method, optimizers, name)
        assert torch.equal(state[: int(keep.sum())], old_moments[name][keep])
        assert state[int(keep.sum()) :].abs().sum() == 0
    assert len(optimizers.rows.state) == len(before)


@pytest.mark.parametrize(("kept", "added"), [(12, 0), (7, 5), (0, 3)])
def test_sorting_while_editing_moves_every_tensor_once_and_to_the_same_place(
    monkeypatch, kept: int, added: int
) -> None:
    found, moved = [], []
    for without in ("densify_once", ""):
        monkeypatch.setenv("WILDGS_WITHOUT", without)
        method, optimizers = trained_baseline()
        torch.manual_seed(1)
        new = {name: torch.randn(added, *rows.shape[1:]) for name, rows in method.gaussians.rows.items()}
        changes: list[str] = []
        change = optimizers_module._change_rows
        monkeypatch.setattr(
            optimizers_module,
            "_change_rows",
            lambda *args: (changes.append("all"), change(*args))[1],  # noqa: B023
        )
        edit_rows(method.gaussians, optimizers.rows, torch.arange(12) < kept, new, sort=True)
        monkeypatch.setattr(optimizers_module, "_change_rows", change)
        moved.append(len(changes))
        found.append(optimizers.state() | {f"row.{n}": r.detach() for n, r in method.gaussians.rows.items()})
    assert moved == [2, 1]
    assert found[0].keys() == found[1].keys()
    for name, wanted in found[0].items():
        assert torch.equal(found[1][name], wanted), name
    assert len(method.gaussians) == kept + added


def test_training_goes_on_after_an_edit() -> None:
    method, optimizers = trained_baseline()
    rows = {name: rows.detach()[:2] for name, rows in method.gaussians.rows.items()}
    edit_rows(method.gaussians, optimizers.rows, torch.ones(12, dtype=torch.bool), rows)
    before = method.gaussians.means.detach().clone()
    method.gaussians.means.sum().backward()
    optimizers.step()
    assert (method.gaussians.means.detach() < before).all()


def test_reset_clears_one_row_only() -> None:
    method, optimizers = trained_baseline()
    reset_moments(optimizers.rows, method.gaussians, "opacity_logits")
    assert moments(method, optimizers, "opacity_logits").abs().sum() == 0
    assert moments(method, optimizers, "means").abs().sum() > 0


@pytest.mark.parametrize(("progress", "expected"), [(0.0, 1.6e-4), (1.0, 1.6e-6), (0.5, 1.6e-5)])
def test_position_rate_falls_exponentially_and_scales_with_the_scene(
    progress: float, expected: float
) -> None:
    _, optimizers = trained_baseline()
    optimizers.set_progress(progress)
    rates = {group["name"]: group["lr"] for group in optimizers.rows.param_groups}
    assert rates["means"] == pytest.approx(expected * 2.0)
    assert rates["log_scales"] == pytest.approx(5e-3)


def test_state_goes_round() -> None:
    method, optimizers = trained_baseline()
    fresh = Optimizers.build(method, OptimizerConfig(), extent=2.0)
    fresh.restore(optimizers.state())
    for name in method.gaussians.rows:
        assert torch.equal(moments(method, fresh, name), moments(method, optimizers, name))


def test_short_runs_move_the_geometry_faster() -> None:
    config = OptimizerConfig(short_runs=0.5)
    long, short, longer = (geometry_rates(config, 2.0, steps) for steps in (30_000, 300, 60_000))
    for row in ("means", "quats", "log_scales"):
        assert short[row].start == pytest.approx(10 * long[row].start)
        assert short[row].decay == long[row].decay
    assert short["opacity_logits"] == long["opacity_logits"]
    assert longer == long
    assert long["means"].start == 2.0 * config.means
