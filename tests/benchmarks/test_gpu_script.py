"""A dry run of all stages of benchmarks/gpu.sh, tiny and on the CPU: that they run, and what they leave."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tarfile
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
STAGES = [
    "install",
    "build",
    "parity",
    "eager",
    "graphs",
    "profile",
    "host",
    "steps",
    "render",
    "train",
    "eval",
    "pack",
]

pytestmark = [
    pytest.mark.skipif(sys.platform != "linux", reason="gpu.sh needs bash, and its test /proc"),
    pytest.mark.timeout(900),
]


def call(python: Path, output: Path, *options: Any) -> subprocess.CompletedProcess[str]:
    command = ["bash", str(ROOT / "benchmarks" / "gpu.sh"), "--output", str(output), *map(str, options)]
    environment = os.environ | {"PYTHON": str(python), "STEPS": "4", "WILDGS_LPIPS": "off"}
    return subprocess.run(command, capture_output=True, text=True, env=environment, timeout=800)


def test_every_stage_runs_and_leaves_its_result(forking_python: Path, landmark: Path, tmp_path: Path):
    done = call(forking_python, tmp_path, "--dry-run", "--scene", landmark, *STAGES)
    report = json.loads((tmp_path / "gpu.json").read_text(encoding="utf-8"))
    codes = {stage["stage"]: stage["exit_code"] for stage in report["stages"]}
    logs = {path.stem: path.read_text()[-600:] for path in (tmp_path / "parts").glob("*.log")}
    # Without a GPU pytest selects nothing that it could run, which is its exit code 5, or lists what it would run.
    assert codes == dict.fromkeys(STAGES[:-1], 0), (done.stdout, logs)
    assert all(row["well"] for name in ("eager", "graphs") for row in report[name] if "well" in row)
    for name in ("profile", "host"):
        assert {(row["method"], row["n"]) for row in report[name]} == {
            (method, n) for method in ("wildgs", "3dgs") for n in (300, 200)
        }
    assert [row["method"] for row in report["steps"]] == ["3dgs", "wildgs"]
    assert report["render"][0]["frames_per_second"] > 0
    assert report["training"]["step"] == 4
    assert report["training"]["eval"]["half"]["mean"]["psnr"] > 0
    with tarfile.open(tmp_path / "gpu.tar.gz") as archive:
        assert {"gpu.json", "parts/stages.jsonl", "parts/steps.out"} <= set(archive.getnames())


def exit_codes(output: Path) -> list[int]:
    lines = (output / "parts" / "stages.jsonl").read_text().splitlines()
    return [json.loads(line)["exit_code"] for line in lines]


def test_earlier_stages_leave_time_to_training(forking_python: Path, landmark: Path, tmp_path: Path):
    """A budget that is smaller than what training reserves goes to training alone, and every stage says so."""
    options = ("--dry-run", "--scene", landmark, "--budget", 100)
    done = call(forking_python, tmp_path, *options, "build", "eager", "train")
    assert done.returncode == 0, done.stderr
    assert exit_codes(tmp_path) == [124, 124, 0]


def test_without_a_training_all_time_goes_to_the_other_stages(forking_python: Path, tmp_path: Path):
    done = call(forking_python, tmp_path, "--dry-run", "--budget", 100, "build")
    assert done.returncode == 0, done.stderr
    assert exit_codes(tmp_path) == [0]


def test_an_unknown_stage_is_named(forking_python: Path, tmp_path: Path):
    done = call(forking_python, tmp_path, "--dry-run", "fly")
    assert done.returncode == 2
    assert "unknown stage fly" in done.stderr


def test_where_gsplat_is_not_to_be_had_it_ends_at_once(tmp_path: Path):
    """A Python with nothing in it, and no wheels for it."""
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(tmp_path / "bare")], check=True)
    (tmp_path / "wheels").mkdir()
    command = ["bash", str(ROOT / "benchmarks" / "gpu.sh"), "--output", str(tmp_path / "out")]
    command += ["--wheels", str(tmp_path / "wheels"), "install", "build"]
    bare = {"PYTHON": str(tmp_path / "bare" / "bin" / "python"), "TORCH_CUDA_ARCH_LIST": "9.0"}
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ | bare, timeout=60)
    assert done.returncode == 1
    assert "gsplat is missing and could not be installed" in done.stderr
    assert len((tmp_path / "out" / "parts" / "stages.jsonl").read_text().splitlines()) == 1
