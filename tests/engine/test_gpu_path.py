"""The way that a step takes on a GPU, without one: on a device that says it is CUDA (benchmarks/pretend_cuda).

Its tensors are real, and operands on different devices are an error as on CUDA; gsplat is stood in for by the CPU
backend. What the real gsplat gives is compared in tests/rasterize, where there is a GPU.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

ROOT = Path(__file__).parents[2]

pytestmark = [
    pytest.mark.skipif(shutil.which("g++") is None, reason="no g++ to make the pretended device with"),
    pytest.mark.skipif(
        torch.version.cuda is not None, reason="this torch has CUDA: tests marked cuda use it"
    ),
    pytest.mark.skipif(sys.platform != "linux", reason="the pretended device is for Linux"),
]


def output_of(script: Path, *options: str) -> Any:
    """What a script prints as JSON; in a process of its own, since the device has to be there before torch."""
    command = [sys.executable, str(script), *options]
    done = subprocess.run(command, capture_output=True, text=True, timeout=400)
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout)


@pytest.fixture(scope="module")
def runs() -> dict[str, Any]:
    return output_of(Path(__file__).with_name("on_pretended_cuda.py"))


@pytest.mark.parametrize("method", ["3dgs", "wildgs"])
def test_training_goes_the_same_way_as_on_the_cpu(runs: dict[str, Any], method: str):
    cpu, cuda = runs[method]["cpu"], runs[method]["cuda"]
    assert cuda["losses"][:3] == pytest.approx(cpu["losses"][:3], rel=1e-4)
    # Rounding grows from step to step; what the runs learn does not.
    assert cuda["losses"][:12] == pytest.approx(cpu["losses"][:12], rel=0.03)
    assert sum(cuda["losses"][-20:]) == pytest.approx(sum(cpu["losses"][-20:]), rel=0.15)
    assert cuda["gaussians"] == cpu["gaussians"] > 576
    assert sum(cuda["resumed"]) == pytest.approx(sum(cpu["resumed"]), rel=0.2)


def test_networks_are_replayed_as_graphs_and_learn(runs: dict[str, Any]):
    assert runs["3dgs"]["graphs"] == 0
    assert runs["wildgs"]["graphs"] >= 3


def test_the_host_waits_for_what_it_must_know_alone():
    """gsplat's list length, which Gaussians are seen (and lie in the box), and whether the step is sound."""
    counts = {count["method"]: count for count in output_of(ROOT / "benchmarks" / "launches.py", "--json")}
    for method, waits in (("3dgs", 3), ("wildgs", 4)):
        assert counts[method]["waits"] <= waits, counts[method]["wait_places"]
    assert counts["wildgs"]["graphs"] >= 2
    assert counts["wildgs"]["launches"] < 3 * counts["3dgs"]["launches"]
