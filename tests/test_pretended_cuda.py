"""Whole trainings, evaluation, rendering and exports on a device that says it is CUDA (benchmarks/pretend_cuda)."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

ROOT = Path(__file__).parent.parent
GSPLAT, ROWS = "gsplat's number of intersections", "nonzero"

pytestmark = [
    pytest.mark.skipif(torch.version.cuda is not None, reason="this torch has CUDA of its own"),
    pytest.mark.skipif(shutil.which("g++") is None, reason="no C++ compiler"),
    pytest.mark.timeout(900),
]


@pytest.fixture(scope="module")
def output(landmark: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the script left: trainings compared with the CPU's, and a run of every method."""
    folder = tmp_path_factory.mktemp("pretended")
    places = os.pathsep.join([str(ROOT / "src"), str(ROOT)])
    environment = os.environ | {"PYTHONPATH": places, "WILDGS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    environment.pop("WILDGS_WITHOUT", None)
    command = [sys.executable, str(ROOT / "tests" / "pretended_cuda.py"), str(landmark), str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=800)
    assert done.returncode == 0, f"{done.stderr[:2000]}\n...\n{done.stderr[-1000:]}"
    return folder


def trainings(output: Path, *, without: bool = False) -> list[dict[str, Any]]:
    found = json.loads((output / "found.json").read_text())
    return [training for training in found if bool(training["without"]) is without]


def waits_of(training: dict[str, Any]) -> dict[str, int]:
    counted: dict[str, int] = {}
    for what, times in training["waits"].items():
        counted[what.partition(",")[0]] = counted.get(what.partition(",")[0], 0) + times
    return counted


def test_no_step_mixes_devices_and_all_learn_what_the_cpu_learns(output: Path) -> None:
    """With densifications and an opacity reset; mixed operands would have ended the script."""
    every = trainings(output) + trainings(output, without=True)
    assert [training["method"] for training in every] == ["3dgs", "wildgs", "affine", "wildgs"]
    for training in every:
        assert training["found"][:4] == pytest.approx(training["wanted"][:4], rel=1e-3), training["method"]
        assert training["found"] == pytest.approx(training["wanted"], rel=5e-2), training["method"]


def test_a_step_waits_for_what_its_sizes_depend_on_alone(output: Path) -> None:
    waits = {training["method"]: waits_of(training) for training in trainings(output)}
    assert waits["3dgs"] == waits["affine"] == {GSPLAT: 1, ROWS: 1}
    assert waits["wildgs"] == {GSPLAT: 1, ROWS: 2}
    (without,) = trainings(output, without=True)
    assert waits_of(without) == {GSPLAT: 1, ROWS: 2, "a number read": 1}


def test_networks_are_replayed(output: Path) -> None:
    """On steps in which the mask or the planes do not learn, too."""
    graphs = {training["method"]: training["graphs"] for training in trainings(output)}
    # Parsing of the scene's one shape of photo, with and without the mask, and the triplane's UNet: one each way.
    # The loss with its gradient: one without a mask, or with a mask that learns and with one that does not.
    # Displacing a photo, and registering it.
    assert graphs == {"3dgs": 1, "wildgs": 10, "affine": 1}
    # Those of SSIM are left, which every method has.
    assert len({training["convolutions"] for training in trainings(output)}) == 1


def test_the_state_lies_on_the_device_but_for_what_the_host_draws(output: Path) -> None:
    for training in trainings(output):
        kinds = {name.partition(".")[0] for name in training["on_cpu"]}
        assert kinds == {"progress", "random", "sampler"}, training["method"]


def test_every_verb_leaves_its_result(output: Path) -> None:
    for method in ("3dgs", "wildgs", "affine"):
        assert (output / method / "checkpoints" / "step_00000010.safetensors").is_file()
        metrics = json.loads((output / method / "eval" / "half" / "metrics.json").read_text())
        assert metrics["device"] == "no GPU, pretended"
        assert metrics["mean"]["psnr"] > 10
    assert list((output / "pictures").rglob("*.png"))
    assert (output / "scene.ply").is_file()
    assert (output / "light.safetensors").is_file()


def test_a_run_of_the_device_opens_on_the_cpu(output: Path) -> None:
    import wildgs

    loaded = wildgs.load(output / "wildgs", device="cpu")
    view = loaded.views[0]
    picture = loaded.render(view.camera, loaded.appearance(view.name))
    assert picture.shape == (view.camera.height, view.camera.width, 3)
    assert picture.float().std() > 1
