"""The loss as a CUDA graph: recorded when shapes recur, and equal to the loss itself.

Recording needs CUDA; here `benchmarks/pretend_cuda` notes the loss's operations and does them again.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.emulated_graphs import emulate_graphs
from wildgs.engine import loss_replay
from wildgs.engine.loss_replay import LossReplays
from wildgs.errors import WildGSWarning
from wildgs.losses import photometric
from wildgs.losses.config import ObjectiveConfig
from wildgs.losses.objective import total_loss
from wildgs.losses.ssim import _ConvolutionSSIM
from wildgs.model.replays import EAGER_CALLS

CONFIG = ObjectiveConfig()


@pytest.fixture(autouse=True)
def _recorder(monkeypatch: pytest.MonkeyPatch) -> None:
    """Torch's recorder, emulated on the CPU, for tensors that say that they are on CUDA."""
    emulate_graphs(monkeypatch)
    monkeypatch.setattr(loss_replay, "is_on_cuda", lambda tensor: True)
    monkeypatch.setattr(
        photometric, "ssim", _ConvolutionSSIM.apply
    )  # kernels of the CPU are no operations of torch


@pytest.fixture
def replays() -> LossReplays:
    made = LossReplays()
    made.switch(True)
    return made


def arguments(seed: int, height: int = 24, width: int = 30, **changes: Any) -> dict[str, Any]:
    generator = torch.Generator().manual_seed(seed)

    def noise(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    options = {
        "visibility": noise(height, width).requires_grad_(),
        "keep": noise(height, width) > 0.1,
        "depth": (1 + noise(height, width)).requires_grad_(),
        "alpha": noise(height, width).requires_grad_(),
        "disparity": noise(height, width),
        "metric_depth": noise(height, width) * (noise(height, width) > 0.5),
        "sky": noise(height, width) > 0.8,
        "sky_depth": 5.0 + seed,
        "observations": noise(7, 2) * torch.tensor([width, height]),
        "train_mask": True,
        "num_photos": 90,
        "doubt": noise(4, 5),
    } | changes
    photo = noise(height, width, 3)
    render = (0.8 * photo + 0.2 * noise(height, width, 3)).requires_grad_()
    return {"config": CONFIG, "progress": 0.1 * seed, "photo": photo, "render": render} | options


def values_and_gradients(function: Any, given: dict[str, Any]) -> list[Tensor]:
    losses = function(**given)
    learnt = [value for value in given.values() if isinstance(value, Tensor) and value.requires_grad]
    gradients = torch.autograd.grad(2 * losses.total, learnt, allow_unused=True, materialize_grads=True)
    return [losses.image, losses.mask, losses.depth, losses.total, *gradients]


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"train_mask": False},
        {"config": replace(CONFIG, opaque_weight=0.0)},
        {"visibility": None, "keep": None},
        {"disparity": None, "metric_depth": None, "sky": None},
        {"observations": None, "doubt": None},
    ],
)
def test_a_replay_has_the_values_and_gradients_of_the_loss(replays: LossReplays, changes: dict[str, Any]):
    for seed in range(EAGER_CALLS + 3):
        given = arguments(seed, **changes)
        found, wanted = (values_and_gradients(function, given) for function in (replays, total_loss))
        for one, other in zip(found, wanted, strict=True):
            torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-6)
    assert replays.recorded == 1


def test_results_of_a_replay_outlast_the_next(replays: LossReplays):
    for seed in range(EAGER_CALLS + 1):
        replays(**arguments(seed))
    given = arguments(7)
    losses = replays(**given)
    wanted = total_loss(**given)
    losses.total.backward()
    found = given["render"].grad
    replays(**arguments(8))
    torch.testing.assert_close(losses.as_floats(), wanted.as_floats())
    (gradient,) = torch.autograd.grad(wanted.total, [given["render"]])
    torch.testing.assert_close(found, gradient, rtol=1e-4, atol=1e-6)


def test_every_shape_is_recorded_once_and_large_photos_are_not(
    replays: LossReplays, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(LossReplays, "most_pixels", 2 * 24 * 30)
    replays.switch(True)
    for width in (30, 20, 29):
        for seed in range(EAGER_CALLS + 2):
            replays(**arguments(seed, width=width))
    assert replays.recorded == 2
    replays.switch(False)
    replays(**arguments(0))
    assert replays.recorded == 0


def test_without_graphs_training_continues(replays: LossReplays, monkeypatch: pytest.MonkeyPatch):
    def fail(*_: Any, **__: Any) -> None:
        raise RuntimeError("operation not permitted")

    monkeypatch.setattr(loss_replay, "captured", fail)
    for seed in range(EAGER_CALLS):
        replays(**arguments(seed))
    given = arguments(EAGER_CALLS)
    with pytest.warns(WildGSWarning, match="operation not permitted"):
        losses = replays(**given)
    torch.testing.assert_close(losses.as_floats(), total_loss(**given).as_floats())
    assert not replays.on
