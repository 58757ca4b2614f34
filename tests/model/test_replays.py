"""What is recorded when, and what happens where it cannot be. Recording itself needs CUDA; see test_gpu_path."""

from __future__ import annotations

import copy
from collections.abc import Callable

import pytest
import torch
from torch import Tensor, nn

from wildgs.errors import WildGSWarning
from wildgs.model import replays as replays_module
from wildgs.model.replays import EAGER_CALLS, MOST_GRAPHS, Replays


class OnCuda(Tensor):
    """A tensor in main memory that says where it is not."""

    is_cuda = True


@pytest.fixture(autouse=True)
def memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "graph_pool_handle", lambda: (0, 1))


@pytest.fixture
def layer() -> nn.Linear:
    torch.manual_seed(0)
    return nn.Linear(3, 2)


def recorder(change: Callable[[Tensor], Tensor] = lambda output: output):
    """Stands for torch's recorder; what it records has its outputs changed."""
    recorded = []

    def record(part, example, allow_unused_input, pool):
        recorded.append(tuple(example[0].shape))
        assert allow_unused_input
        assert pool == (0, 1)
        return lambda x: tuple(change(output) for output in part(x))

    return record, recorded


def call(replays: Replays, layer: nn.Linear, rows: int = 4, scale: float = 1.0) -> Tensor:
    x = torch.linspace(-1, 1, 3 * rows).reshape(rows, 3).as_subclass(OnCuda)
    (output,) = replays(lambda x, scale: (layer(x) * scale,), (layer,), x, (scale,))
    return output.as_subclass(Tensor)


def test_a_shape_that_comes_again_is_recorded_once(monkeypatch: pytest.MonkeyPatch, layer: nn.Linear):
    record, recorded = recorder()
    monkeypatch.setattr(torch.cuda, "make_graphed_callables", record)
    replays = Replays()
    call(replays, layer)
    replays.switch(True)
    wanted = [call(replays, layer) for _ in range(EAGER_CALLS)]
    assert recorded == []
    for _ in range(3):
        torch.testing.assert_close(call(replays, layer), wanted[0])
    assert recorded == [(4, 3)]
    for _ in range(EAGER_CALLS + 1):
        call(replays, layer, rows=5)
        call(replays, layer, scale=2.0)
    assert recorded == [(4, 3), (5, 3), (4, 3)]
    call(replays, layer).sum().backward()
    assert layer.weight.grad is not None
    replays.switch(True)
    call(replays, layer)
    assert len(recorded) == 3


def test_no_gradient_no_graph_and_not_without_end(monkeypatch: pytest.MonkeyPatch, layer: nn.Linear):
    record, recorded = recorder()
    monkeypatch.setattr(torch.cuda, "make_graphed_callables", record)
    replays = Replays()
    replays.switch(True)
    with torch.no_grad():
        for _ in range(EAGER_CALLS + 2):
            call(replays, layer)
    assert recorded == []
    for rows in range(1, MOST_GRAPHS + 5):
        for _ in range(EAGER_CALLS + 1):
            call(replays, layer, rows)
    assert len(recorded) == MOST_GRAPHS


def test_a_graph_that_gives_other_numbers_is_not_used(monkeypatch: pytest.MonkeyPatch, layer: nn.Linear):
    monkeypatch.setattr(torch.cuda, "make_graphed_callables", recorder(lambda output: output * 1.2)[0])
    replays = Replays()
    replays.switch(True)
    for _ in range(EAGER_CALLS):
        wanted = call(replays, layer)
    with pytest.warns(WildGSWarning, match="a replay gives other numbers.*continues without"):
        torch.testing.assert_close(call(replays, layer), wanted)
    assert not replays.on


def test_where_recording_fails_training_goes_on(monkeypatch: pytest.MonkeyPatch, layer: nn.Linear):
    def fails(*_, **__):
        raise RuntimeError("operation not permitted when stream is capturing\nand more")

    monkeypatch.setattr(torch.cuda, "make_graphed_callables", fails)
    replays = Replays()
    replays.switch(True)
    for _ in range(EAGER_CALLS):
        call(replays, layer)
    with pytest.warns(WildGSWarning, match="operation not permitted when stream is capturing\\)"):
        call(replays, layer).sum().backward()
    assert layer.weight.grad is not None
    call(replays, layer)


def test_a_copy_has_nothing_recorded(monkeypatch: pytest.MonkeyPatch, layer: nn.Linear):
    record, recorded = recorder()
    monkeypatch.setattr(torch.cuda, "make_graphed_callables", record)
    replays = Replays()
    replays.switch(True)
    for _ in range(EAGER_CALLS + 1):
        call(replays, layer)
    twin = copy.deepcopy(replays)
    assert twin.on
    call(twin, layer)
    assert len(recorded) == 1


class Noisy(nn.Module):
    """A network whose last parameter gets another gradient each time, as one that is summed with atomics does."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.large, self.small = nn.Linear(64, 64), nn.Parameter(torch.ones(1))

    def forward(self, x: Tensor) -> tuple[Tensor]:
        return (self.large(x) + self.small - self.small.detach(),)


@pytest.mark.parametrize(("change", "accepted"), [(1.1, True), (40.0, False)])
def test_a_small_gradient_that_varies_does_not_reject_a_recording(
    monkeypatch: pytest.MonkeyPatch, change: float, accepted: bool
):
    network = Noisy()
    learnt = list(network.parameters())
    x = torch.randn(8, 64, generator=torch.Generator().manual_seed(1))
    wanted = replays_module._values_and_gradients(network, x, learnt)
    with torch.no_grad():
        wanted[1][-1].mul_(change)
    found = replays_module._values_and_gradients(network, x, learnt)
    assert all(map(replays_module._alike, wanted, found)) is accepted


def test_streams_are_overridden_while_recording_alone(monkeypatch: pytest.MonkeyPatch, layer: nn.Linear):
    said: list[object] = []
    monkeypatch.setattr(torch.autograd.graph, "set_override_stale_capture_stream", said.append, raising=False)
    record, recorded = recorder()

    def records(*arguments, **keywords):
        said.append("record")
        return record(*arguments, **keywords)

    monkeypatch.setattr(torch.cuda, "make_graphed_callables", records)
    replays = Replays()
    replays.switch(True)
    for _ in range(EAGER_CALLS + 2):
        call(replays, layer)
    assert said == [True, "record", False]
    assert len(recorded) == 1
