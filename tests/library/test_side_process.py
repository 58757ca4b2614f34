"""`wildgs.library.side_process`: what it compiles in advance is what a training calls."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

CODE = """
import sys
from pathlib import Path

from wildgs.config import RunConfig
from wildgs.engine.config import TrainConfig
from wildgs.library.side_process import compile_kernels
from wildgs.library.training import train
from wildgs.losses import ssim_kernels
from wildgs.rasterize.cpu import backward_kernels, forward_kernels, project_backward_kernels, sh_kernels

kernels = (
    ssim_kernels.ssim_forward,
    forward_kernels.blend_forward,
    backward_kernels.blend_backward,
    backward_kernels.sum_rows,
    project_backward_kernels.project_backward,
    sh_kernels.shade_backward,
)
compile_kernels()
before = [set(kernel.overloads) for kernel in kernels]
scene, method, output = sys.argv[1:]
config = RunConfig(Path(scene), train=TrainConfig(steps=3)).with_method(method)
train(config.scene, config, output=output)
for kernel, signatures in zip(kernels, before, strict=True):
    print(kernel.py_func.__name__, len(signatures), len(set(kernel.overloads) - signatures))
"""


@pytest.mark.parametrize("method", ["wildgs", "3dgs"])
def test_a_training_compiles_none_of_these_kernels_again(landmark: Path, tmp_path: Path, method: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", CODE, str(landmark.resolve()), method, str(tmp_path / "run")],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    counts = [line.split() for line in done.stdout.splitlines()]
    assert len(counts) == 6
    assert {name: (compiled, more) for name, compiled, more in counts} == {
        name: ("1", "0") for name, *_ in counts
    }
