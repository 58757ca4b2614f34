"""`wildgs.library.side_training`: one training in another process."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from wildgs.config import ExecutionConfig, RunConfig
from wildgs.config_file import write_config
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


PARENT = """
import sys
import time
from pathlib import Path

from wildgs.config import ExecutionConfig
from wildgs.config_file import read_config
from wildgs.library.side_training import training_beside

config, folder = map(Path, sys.argv[1:])
with training_beside(read_config(config), folder, ExecutionConfig(threads=2)) as (_, process):
    print(process.pid, flush=True)
    time.sleep(300)
"""


def is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    # An orphan that has ended stays in the table of processes where nobody waits for it.
    state = Path(f"/proc/{pid}/stat")
    return not state.exists() or state.read_text().rsplit(")", 1)[1].split()[0] != "Z"


@pytest.mark.skipif(sys.platform == "win32", reason="processes are killed by POSIX signals")
def test_it_ends_when_its_parent_is_killed(config: RunConfig, tmp_path: Path) -> None:
    write_config(tmp_path / "config.yaml", replace(config, train=TrainConfig(steps=1_000_000)))
    run = tmp_path / "run"
    command = [sys.executable, "-c", PARENT, str(tmp_path / "config.yaml"), str(run)]
    (tmp_path / "temporary").mkdir()
    environment = os.environ | {"TMPDIR": str(tmp_path / "temporary")}
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as parent:
        assert parent.stdout is not None
        child = int(parent.stdout.readline())
        deadline = time.monotonic() + 120
        while not (run / "config.yaml").exists() and time.monotonic() < deadline:
            time.sleep(0.2)
        assert is_alive(child)
        parent.send_signal(signal.SIGKILL)
    while is_alive(child) and time.monotonic() < deadline:
        time.sleep(0.2)
    assert not is_alive(child)
    assert list((tmp_path / "temporary").glob("wildgs*")) == []
