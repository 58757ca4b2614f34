"""What training changes in its process holds while it runs, and is undone after it."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
import torch

from wildgs.engine.process_settings import ProcessSettings
from wildgs.processes import LIBRARY_DEFAULTS, library_environment


def flushed() -> bool:
    return float(torch.full((1,), 1e-40).mul(1.0)) == 0


def test_settings_hold_between_begin_and_end(monkeypatch: pytest.MonkeyPatch):
    for name in LIBRARY_DEFAULTS:
        monkeypatch.delenv(name, raising=False)
    torch.manual_seed(3)
    settings = ProcessSettings(torch.device("cpu"))
    torch.manual_seed(4)
    wanted_outside = torch.rand(4)
    torch.manual_seed(4)
    settings.begin()
    inside = torch.rand(2)
    assert flushed()
    assert os.environ["MKL_CBWR"] == "AUTO,STRICT"
    settings.end()
    assert not flushed()
    assert "MKL_CBWR" not in os.environ
    assert torch.equal(torch.rand(4), wanted_outside), "the process's own generator was moved"
    settings.begin()
    inside = torch.cat([inside, torch.rand(2)])
    settings.end()
    torch.manual_seed(3)
    assert torch.equal(inside, torch.rand(4)), "the training's generator lost its place"


def test_states_are_the_trainings_after_its_end_too():
    settings = ProcessSettings(torch.device("cpu"))
    settings.begin()
    torch.rand(5)
    wanted = settings.random_states()["torch"]
    settings.end()
    torch.manual_seed(9)
    assert torch.equal(settings.random_states()["torch"], wanted)
    other = ProcessSettings(torch.device("cpu"))
    other.set_random_states({"torch": wanted, "cuda": torch.zeros(16, dtype=torch.uint8)})
    assert torch.equal(other.random_states()["torch"], wanted)


def test_the_users_own_environment_wins(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("MKL_CBWR", "COMPATIBLE")
    with library_environment():
        assert os.environ["MKL_CBWR"] == "COMPATIBLE"
    assert os.environ["MKL_CBWR"] == "COMPATIBLE"


def test_importing_changes_nothing_in_the_process():
    code = """
import os, torch
before, seed = dict(os.environ), torch.get_rng_state()
import wildgs.engine.trainer, wildgs.model.wildgs, wildgs.rasterize.cpu
assert dict(os.environ) == before, set(os.environ) ^ set(before)
assert torch.equal(torch.get_rng_state(), seed)
assert float(torch.full((1,), 1e-40).mul(1.0)) != 0
"""
    environment = {name: value for name, value in os.environ.items() if name not in LIBRARY_DEFAULTS}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr[-2000:]
