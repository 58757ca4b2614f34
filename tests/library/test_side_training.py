"""`wildgs.library.side_training`: one training in another process."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from wildgs.config import ExecutionConfig, RunConfig
from wildgs.engine.config import TrainConfig
from wildgs.library.side_training import training_beside
from wildgs.runs import load_run
from wildgs.threads import limited, thread_count


@pytest.fixture
def config(landmark: Path) -> RunConfig:
    return RunConfig(landmark.resolve(), train=TrainConfig(steps=3)).with_method("3dgs")


def test_the_other_process_finishes_its_run(config: RunConfig, tmp_path: Path) -> None:
    with limited(2), training_beside(config, tmp_path / "run", ExecutionConfig()) as (observe, process):
        assert process is not None
        assert thread_count() == 1
        assert process.wait(120) == 0
        observe(object())
        assert thread_count() == 2
        assert torch.get_num_threads() == 1, "torch's threads hardly help, and wait for each other"
    assert load_run(tmp_path / "run").step == 3


def test_it_ends_with_the_block(config: RunConfig, tmp_path: Path) -> None:
    long = replace(config, train=TrainConfig(steps=1_000_000))
    start = time.monotonic()
    with (
        pytest.raises(ZeroDivisionError),
        training_beside(long, tmp_path / "run", ExecutionConfig(threads=2)) as (_, process),
    ):
        raise ZeroDivisionError
    assert process is not None
    assert process.poll() is not None
    assert time.monotonic() - start < 60


def test_one_thread_is_not_divided(config: RunConfig, tmp_path: Path) -> None:
    with training_beside(config, tmp_path / "run", ExecutionConfig(threads=1)) as (_, process):
        assert process is None
    assert not (tmp_path / "run").exists()
