"""What is recorded when, what a replay gives, and what happens where nothing can be recorded.

Recording itself needs CUDA; here `benchmarks/pretend_cuda` notes a network's operations and does them again.
"""

from __future__ import annotations

import copy
from contextlib import contextmanager
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from tests.emulated_graphs import emulate_graphs
from wildgs.errors import WildGSWarning
from wildgs.model import replays as replays_module
from wildgs.model.parsing import Parsing
from wildgs.model.replays import EAGER_CALLS, MOST_GRAPHS, Recording, Replays
from wildgs.model.wildgs import WildGSConfig


class OnCuda(Tensor):
    """A tensor in main memory that says where it is not."""

    is_cuda = True


@pytest.fixture(autouse=True)
def recorded(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Torch's recorder, emulated; gives the capture mode of every graph that was captured."""
    return emulate_graphs(monkeypatch)


@pytest.fixture
def layer() -> nn.Linear:
    torch.manual_seed(0)
    return nn.Linear(3, 2)


@pytest.fixture
def replays() -> Replays:
    made = Replays()
    made.switch(True)
    return made


def call(
    replays: Replays, layer: nn.Module, rows: int = 4, scale: float = 1.0, start: float = -1.0
) -> Tensor:
    x = torch.linspace(start, 1, 3 * rows).reshape(rows, 3).as_subclass(OnCuda)
    (output,) = replays(lambda x, scale: (layer(x) * scale,), (layer,), x, (scale,))
    return output.as_subclass(Tensor)


def test_a_shape_that_comes_again_is_recorded_once(replays: Replays, layer: nn.Linear, recorded: list[str]):
    replays.switch(False)
    call(replays, layer)
    replays.switch(True)
    wanted = [call(replays, layer) for _ in range(EAGER_CALLS)]
    assert replays.recorded == 0
    for _ in range(3):
        torch.testing.assert_close(call(replays, layer), wanted[0])
    assert replays.recorded == 1
    # Only this thread's calls can fail a capture: others decode photos and write checkpoints meanwhile.
    assert recorded == ["thread_local"] * 2
    for _ in range(EAGER_CALLS + 1):
        call(replays, layer, rows=5)
        call(replays, layer, scale=2.0)
    assert replays.recorded == 3
    replays.switch(True)
    call(replays, layer)
    assert replays.recorded == 0


@pytest.mark.parametrize("without", ["", "written_gradients"])
def test_a_replay_trains_as_the_network_does(
    replays: Replays, layer: nn.Linear, monkeypatch: pytest.MonkeyPatch, without: str
):
    """Other inputs than those of the recording, and weights that learn meanwhile."""
    monkeypatch.setenv("WILDGS_WITHOUT", without)
    twin, off = copy.deepcopy(layer), Replays()
    for each, network in ((replays, layer), (off, twin)):
        optimizer = torch.optim.Adam(network.parameters(), lr=0.1, fused=True)
        for step in range(8):
            call(each, network, start=-step).square().sum().backward()
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
    assert replays.recorded == 1
    torch.testing.assert_close(layer.weight, twin.weight, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(layer.bias, twin.bias, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("without", ["", "written_gradients"])
def test_an_input_that_requires_one_gets_a_gradient(
    replays: Replays, layer: nn.Linear, monkeypatch: pytest.MonkeyPatch, without: str
):
    monkeypatch.setenv("WILDGS_WITHOUT", without)
    gradients = []
    for step in range(EAGER_CALLS + 3):
        x = torch.full((4, 3), float(step), requires_grad=True)
        wanted, *_ = torch.autograd.grad((layer(x).square()).sum(), [x])
        (output,) = replays(lambda x: (layer(x),), (layer,), x.as_subclass(OnCuda))
        output.as_subclass(Tensor).square().sum().backward()
        assert x.grad is not None
        torch.testing.assert_close(x.grad, wanted)
        gradients.append(x.grad)
    assert replays.recorded == 1
    assert not torch.equal(gradients[-1], gradients[-2])  # of memory of its own


@pytest.mark.parametrize("without", ["", "written_gradients"])
def test_gradients_of_two_replays_add_up(
    replays: Replays, layer: nn.Linear, monkeypatch: pytest.MonkeyPatch, without: str
):
    monkeypatch.setenv("WILDGS_WITHOUT", without)
    twin, off = copy.deepcopy(layer), Replays()
    for _ in range(EAGER_CALLS + 1):
        call(replays, layer)
    for each, network in ((replays, layer), (off, twin)):
        for start in (-1.0, -3.0):
            call(each, network, start=start).square().sum().backward()
    torch.testing.assert_close(layer.weight.grad, twin.weight.grad)


def test_no_accumulator_of_an_eager_step_takes_part_and_none_runs_in_a_replay(
    replays: Replays, layer: nn.Linear
):
    """An accumulator that an eager step left is bound to that step's stream, which would invalidate a capture."""
    kept = [call(replays, layer) for _ in range(EAGER_CALLS)]
    accumulator = torch.autograd.graph.get_gradient_edge(layer.weight).node
    ran: list[str] = []
    accumulator.register_prehook(lambda *_: ran.append("accumulator"))
    call(replays, layer).sum().backward()
    assert replays.recorded == 1
    ran.clear()  # of the eager pass with which the recording was compared
    call(replays, layer).sum().backward()
    assert layer.weight.grad is not None
    assert not ran
    del kept


def test_gradients_lie_as_their_parameters_do(replays: Replays):
    """Fused Adam takes both as they lie in memory."""
    torch.manual_seed(0)
    network = nn.Conv2d(4, 6, 3).to(memory_format=torch.channels_last)
    x = torch.randn(1, 4, 8, 8).as_subclass(OnCuda)
    for _ in range(EAGER_CALLS + 2):
        network.zero_grad(set_to_none=True)
        replays(lambda x: (network(x),), (network,), x)[0].as_subclass(Tensor).square().sum().backward()
    assert replays.recorded == 1
    assert network.weight.grad is not None
    assert network.weight.grad.stride() == network.weight.stride()


def test_no_gradient_no_graph_and_not_without_end(replays: Replays, layer: nn.Linear):
    with torch.no_grad():
        for _ in range(EAGER_CALLS + 2):
            call(replays, layer)
    assert replays.recorded == 0
    for rows in range(1, MOST_GRAPHS + 5):
        for _ in range(EAGER_CALLS + 1):
            call(replays, layer, rows)
    assert replays.recorded == MOST_GRAPHS


def test_photos_of_all_proportions_come_in_fewer_shapes_than_graphs():
    """Also where each comes with and without a mask that learns."""
    parsing = Parsing(WildGSConfig().parsing).to("meta")
    shapes = set()
    for long_side in (480, 1000, 1600):
        for short_side in range(120, long_side + 1, 4):
            photo = torch.empty(short_side, long_side, 3, device="meta")
            shapes |= {tuple(parsing.shrink(p).shape[2:]) for p in (photo, photo.transpose(0, 1))}
    assert len(shapes) == 9
    assert 2 * len(shapes) <= MOST_GRAPHS


def test_a_graph_that_gives_other_numbers_is_not_used(
    replays: Replays, monkeypatch: pytest.MonkeyPatch, layer: nn.Linear
):
    replay = Recording.replay_forward
    monkeypatch.setattr(Recording, "replay_forward", lambda *args: tuple(1.2 * y for y in replay(*args)))
    for _ in range(EAGER_CALLS):
        wanted = call(replays, layer)
    with pytest.warns(WildGSWarning, match="results of a replay differ.*continues without"):
        torch.testing.assert_close(call(replays, layer), wanted)
    assert not replays.on


def test_where_recording_fails_training_goes_on(
    replays: Replays, monkeypatch: pytest.MonkeyPatch, layer: nn.Linear
):
    """On the stream on which it was: a capture that fails leaves its own the current one."""

    @contextmanager
    def fails(*_: Any, **__: Any):
        yield
        raise RuntimeError("operation not permitted when stream is capturing\nand more")

    monkeypatch.setattr(torch.cuda, "Stream", lambda: "another")
    monkeypatch.setattr(torch.cuda, "current_stream", lambda: "training's")
    monkeypatch.setattr(torch.cuda, "graph", fails)
    entered = []

    class Stream:
        def __init__(self, name: str) -> None:
            self.name = name

        def __enter__(self) -> None:
            entered.append(self.name)

        def __exit__(self, *_: object) -> None:
            entered.append(f"out of {self.name}")

    monkeypatch.setattr(torch.cuda, "stream", Stream)
    for _ in range(EAGER_CALLS):
        call(replays, layer)
    with pytest.warns(WildGSWarning, match="operation not permitted when stream is capturing\\)"):
        call(replays, layer).sum().backward()
    assert entered == ["another", "out of another", "training's", "out of training's"]
    assert layer.weight.grad is not None
    call(replays, layer)


def test_a_copy_has_nothing_recorded(replays: Replays, layer: nn.Linear):
    for _ in range(EAGER_CALLS + 1):
        call(replays, layer)
    twin = copy.deepcopy(replays)
    assert twin.on
    call(twin, layer)
    assert (replays.recorded, twin.recorded) == (1, 0)


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
    assert all(map(replays_module.alike, wanted, found)) is accepted
