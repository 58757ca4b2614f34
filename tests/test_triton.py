"""Triton's kernels give what the CPU's do; interpreted, so that no GPU is needed."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

from wildgs import features
from wildgs.errors import WildGSWarning

SCRIPT = Path(__file__).with_name("triton_kernels.py")


@pytest.mark.skipif(importlib.util.find_spec("triton") is None, reason="triton is not installed")
@pytest.mark.parametrize("part", ["ssim", "planes", "compile"])
def test_kernels_give_what_the_cpu_gives_and_compile(part: str):
    """Interpreted; and compiled to machine code for sm_80 and sm_90 by the assembler that comes with Triton."""
    environment = os.environ | {"TRITON_INTERPRET": str(int(part != "compile"))}
    command = [sys.executable, str(SCRIPT), part]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=250)
    assert done.returncode == 0, done.stderr[-3000:]


def test_features_can_be_switched_off_one_by_one(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("WILDGS_WITHOUT", "triton_ssim, spread_rejected")
    assert [name for name in features.FEATURES if not features.is_on(name)] == [
        "triton_ssim",
        "spread_rejected",
    ]
    assert not features.has_triton("triton_ssim", lambda: None)
    with pytest.raises(ValueError, match="unknown feature 'fast'"):
        features.is_on("fast")


def test_kernels_that_do_not_run_here_are_left_out(monkeypatch: pytest.MonkeyPatch):
    """Triton compiles at the first call, with a C compiler that a machine with a built gsplat need not have."""
    monkeypatch.setattr(features, "_runs_here", {})
    monkeypatch.setattr(features, "_runs_triton", lambda: True)
    calls: list[str] = []

    def probe() -> None:
        calls.append("probe")
        raise RuntimeError("Failed to find C compiler.\nSet CC")

    with pytest.warns(
        WildGSWarning, match=r"do not work here \(Failed to find C compiler.\).*WILDGS_WITHOUT"
    ):
        assert not features.has_triton("triton_planes", probe)
    assert not features.has_triton("triton_planes", probe)
    assert calls == ["probe"]
    assert features.has_triton("triton_ssim", lambda: None)
