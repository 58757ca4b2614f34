"""Triton's kernels give what the CPU's do; interpreted, so that no GPU is needed."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

from wildgs import features

SCRIPT = Path(__file__).with_name("triton_kernels.py")


@pytest.mark.skipif(importlib.util.find_spec("triton") is None, reason="triton is not installed")
@pytest.mark.parametrize("kernels", ["ssim", "planes"])
def test_interpreted_kernels_give_what_the_cpu_gives(kernels: str):
    environment = os.environ | {"TRITON_INTERPRET": "1"}
    command = [sys.executable, str(SCRIPT), kernels]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=250)
    assert done.returncode == 0, done.stderr[-3000:]


def test_features_can_be_switched_off_one_by_one(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("WILDGS_WITHOUT", "triton_ssim, spread_rejected")
    assert [name for name in features.FEATURES if not features.is_on(name)] == [
        "triton_ssim",
        "spread_rejected",
    ]
    assert not features.has_triton("triton_ssim")
    with pytest.raises(ValueError, match="no feature 'fast'"):
        features.is_on("fast")
