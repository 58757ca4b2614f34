import json
import os
import subprocess
import sys

import pytest

from wildgs.cli.doctor import Command, run
from wildgs.evaluation.lpips import ENVIRONMENT
from wildgs.library import doctor
from wildgs.library.doctor import Check, examine


@pytest.fixture(autouse=True)
def empty_caches(monkeypatch, tmp_path):
    """Caches of weights that hold nothing, whatever this machine has."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path / "hub"))
    monkeypatch.delenv(ENVIRONMENT, raising=False)


def by_name() -> dict[str, Check]:
    return {check.name: check for check in examine()}


def test_what_every_installation_has_works():
    checks = by_name()
    for name in ("Python", "PyTorch", "CPU", "Numba", "rasteriser on the CPU", "poses from photos"):
        assert checks[name].state == "works", checks[name]
    assert "threads" in checks["Numba"].detail


def test_missing_weights_come_with_the_command_that_gets_them():
    checks = by_name()
    assert checks["depth weights"].state == "missing"
    assert checks["depth weights"].remedy == "hf download depth-anything/Depth-Anything-V2-Small-hf"


def test_packaged_weights_work(monkeypatch):
    monkeypatch.delenv(ENVIRONMENT, raising=False)
    checks = by_name()
    assert checks["encoder weights"].state == "works"
    assert checks["LPIPS weights"].state == "works"
    assert "(squeeze)" in checks["LPIPS weights"].detail


def test_cached_weights_are_seen(monkeypatch, tmp_path):
    repository = tmp_path / "hub" / "models--depth-anything--Depth-Anything-V2-Small-hf"
    snapshot = repository / "snapshots" / ("a" * 40)
    snapshot.mkdir(parents=True)
    (snapshot / "model.safetensors").write_bytes(b"weights")
    (repository / "refs").mkdir()
    (repository / "refs" / "main").write_text("a" * 40)
    assert by_name()["depth weights"].state == "works"


def test_broken_lpips_weights_are_broken(monkeypatch, tmp_path):
    (tmp_path / "alexnet.pth").write_bytes(b"no weights")
    (tmp_path / "alex.pth").write_bytes(b"no weights")
    monkeypatch.setenv(ENVIRONMENT, str(tmp_path))
    check = by_name()["LPIPS weights"]
    assert check.state == "broken"
    assert "alexnet.pth" in check.detail


def test_a_check_that_fails_does_not_stop_the_others(monkeypatch):
    def fail() -> Check:
        raise OSError("the library is gone\nwith details")

    monkeypatch.setattr(doctor, "_pycolmap", fail)
    checks = by_name()
    assert checks["poses from photos"].state == "broken"
    assert checks["poses from photos"].detail == "OSError: the library is gone"
    assert checks["Python"].state == "works"


def test_table_shows_remedies_unbroken(capsys, monkeypatch):
    remedy = "hf download " + "x" * 200
    monkeypatch.setattr(
        doctor, "examine", lambda: [Check("encoder weights", "missing", "[odd] detail", remedy)]
    )
    run(Command())
    printed = capsys.readouterr().out
    assert remedy in printed
    assert "[odd] detail" in printed


def test_json_from_the_command_line(tmp_path):
    environment = {**os.environ, "TORCH_HOME": str(tmp_path), "HF_HOME": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", "from wildgs.cli import main; main(['doctor', '--json'])"],
        capture_output=True,
        text=True,
        env=environment,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert {entry["state"] for entry in report} <= {"works", "missing", "broken"}
    assert {"name", "state", "detail", "remedy"} == set(report[0])


def test_gsplat_that_is_not_built_comes_with_the_command_that_builds_it(monkeypatch, tmp_path):
    monkeypatch.setenv("TORCH_EXTENSIONS_DIR", str(tmp_path))
    monkeypatch.setattr("wildgs.rasterize.gsplat_library.toolkit_problem", lambda: None)
    check = doctor._gsplat("rasteriser on CUDA")
    assert check.state == "missing"
    assert (check.remedy or "").endswith("wildgs doctor --build-gsplat")
    monkeypatch.setattr("wildgs.rasterize.gsplat_library.toolkit_problem", lambda: "nvcc is not installed")
    assert doctor._gsplat("rasteriser on CUDA").state == "broken"
