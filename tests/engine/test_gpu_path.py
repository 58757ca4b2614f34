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

import pytest
import torch

ROOT = Path(__file__).parents[2]
BENCHMARKS = ROOT / "benchmarks"

pytestmark = [
    pytest.mark.skipif(shutil.which("g++") is None, reason="no g++ to make the pretended device with"),
    pytest.mark.skipif(
        torch.version.cuda is not None, reason="this torch has CUDA: tests marked cuda use it"
    ),
    pytest.mark.skipif(sys.platform != "linux", reason="the pretended device is for Linux"),
]


def output_of(script: Path, *options: str) -> str:
    """What a script prints; in a process of its own, since the device has to be there before torch."""
    command = [sys.executable, str(script), *options]
    done = subprocess.run(command, capture_output=True, text=True, timeout=400, cwd=ROOT)
    assert done.returncode == 0, (done.stdout + done.stderr)[-4000:]
    return done.stdout


def test_tests_that_need_cuda_pass_on_the_pretended_device():
    """All but the rasteriser's, which compare gsplat with the CPU backend that stands for it here."""
    files = [str(ROOT / "tests" / room / "test_cuda.py") for room in ("engine", "model")]
    printed = output_of(BENCHMARKS / "pretend_cuda", "-q", "-p", "no:cacheprovider", *files)
    assert "skipped" not in printed.splitlines()[-1], printed[-500:]


def test_the_host_waits_for_what_it_must_know_alone():
    """gsplat's list length, which Gaussians are seen (and lie in the box), and whether the step is sound."""
    printed = output_of(BENCHMARKS / "launches.py", "--json", "--first-steps", "18")
    counts = {count["method"]: count for count in json.loads(printed)}
    for method, waits in (("3dgs", 3), ("wildgs", 4)):
        assert counts[method]["waits"] <= waits, counts[method]["wait_places"]
    assert counts["wildgs"]["graphs"] >= 2
    assert counts["wildgs"]["launches"] < 3 * counts["3dgs"]["launches"]
