"""Training that is killed ends in the same bits: a short form of benchmarks/kill_and_resume.py."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parent.parent / "benchmarks" / "kill_and_resume.py"


@pytest.mark.timeout(900)
def test_killed_training_ends_in_the_same_bits() -> None:
    command = [sys.executable, str(SCRIPT), "--moments", "3", "--steps", "60", "--every", "6"]
    result = subprocess.run([*command, "--writing", "0.6"], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
    assert "the same bits" in result.stdout
