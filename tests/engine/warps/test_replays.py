"""Functions as CUDA graphs: recorded when shapes recur, and equal to the function itself.

Recording needs CUDA; here `benchmarks/pretend_cuda` notes operations and does them again.
"""

from __future__ import annotations

import warnings

import pytest
import torch
from torch import Tensor

from tests.emulated_graphs import emulate_graphs
from wildgs.engine.warps.replays import FunctionReplays
from wildgs.errors import WildGSWarning
from wildgs.model.replays import EAGER_CALLS
from wildgs.priors.resampling import interpolated, sampled


@pytest.fixture
def replays(monkeypatch: pytest.MonkeyPatch) -> FunctionReplays:
    """Torch's recorder, emulated on the CPU, for tensors that say that they are on CUDA."""
    emulate_graphs(monkeypatch)
    monkeypatch.setattr(FunctionReplays, "records", lambda self, x: self.on)
    made = FunctionReplays()
    made.switch(True)
    return made


def displaced(photo: Tensor, grid: Tensor) -> Tensor:
    """What `warp` does on a GPU."""
    return sampled(photo, interpolated(grid, *photo.shape[:2]))


def doubled(photo: Tensor, grid: Tensor) -> Tensor:
    return 2 * photo + grid.mean()


def inputs(seed: int, height: int = 20, width: int = 24) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    photo = torch.rand(height, width, 3, generator=generator)
    return photo, torch.rand(2, 5, 5, generator=generator)


def test_replays_give_what_the_function_gives(replays: FunctionReplays) -> None:
    results = []
    for seed in range(EAGER_CALLS + 4):
        for function in (displaced, doubled):
            found = replays(function, *inputs(seed))
            torch.testing.assert_close(found, function(*inputs(seed)))
            results.append((found, found.clone()))
    assert replays.recorded == 2
    for found, kept in results:
        assert torch.equal(found, kept)


def test_every_shape_has_a_graph_of_its_own(replays: FunctionReplays) -> None:
    for seed in range(EAGER_CALLS + 2):
        for width in (24, 31):
            given = inputs(seed, width=width)
            torch.testing.assert_close(replays(displaced, *given), displaced(*given))
    assert replays.recorded == 2


def test_nothing_is_recorded_while_switched_off(replays: FunctionReplays) -> None:
    replays.switch(False)
    for seed in range(EAGER_CALLS + 2):
        replays(displaced, *inputs(seed))
    assert replays.recorded == 0


def test_a_function_that_cannot_be_replayed_runs_as_it_is(replays: FunctionReplays) -> None:
    calls = [0]

    def changing(photo: Tensor, grid: Tensor) -> Tensor:
        calls[0] += 1
        return calls[0] * photo

    photo, grid = inputs(0)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for _ in range(EAGER_CALLS + 3):
            found = replays(changing, photo, grid)
            torch.testing.assert_close(found, calls[0] * photo)
    assert [warning.category for warning in caught] == [WildGSWarning]
    assert not replays.on
