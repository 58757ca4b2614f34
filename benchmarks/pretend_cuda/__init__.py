"""A device that says it is CUDA and computes on the CPU: counts what a GPU would be told to do, without one.

Tensors on it are real, so whole trainings run, and it counts how many kernels a step launches and where the host
waits for the device; operands on two devices are an error, and so is a wait while a graph is captured. It says
nothing about times, streams or gsplat's kernels.

    import pretend_cuda
    pretend_cuda.prepare()          # before torch is imported; needs g++
    with pretend_cuda.device() as record:
        ...                         # torch.device("cuda") exists in here
"""

from __future__ import annotations

import ctypes
import importlib.util
import os
import shutil
import subprocess
import sys
import tempfile
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .tensors import Record


def prepare() -> None:
    """Compiles and loads the device, which has to be there before torch.

    Raises:
        SystemExit: torch is loaded already, has CUDA of its own, or there is no compiler.
    """
    compiler = os.environ.get("CXX") or shutil.which("g++") or shutil.which("c++")
    if compiler is None:
        raise SystemExit("a pretended CUDA device needs a C++ compiler (g++), and there is none")
    if "torch" in sys.modules:
        raise SystemExit("the pretended CUDA device has to be prepared before torch is imported")
    spec = importlib.util.find_spec("torch")
    if spec is None or spec.origin is None:
        raise SystemExit("there is no torch")
    folder = Path(spec.origin).parent
    if (folder / "lib" / "libtorch_cuda.so").exists():
        raise SystemExit("this torch has CUDA itself; pretending is for builds that have not")
    source, core = Path(__file__).with_name("device.cpp"), folder / "lib" / "libc10.so"
    with tempfile.TemporaryDirectory() as made:
        library = Path(made) / "device.so"
        flags = ["-std=c++20", "-O0", "-shared", "-fPIC", f"-I{folder / 'include'}"]
        subprocess.run([compiler, *flags, str(source), "-o", str(library), str(core)], check=True)
        # First of all: what torch's libraries look up, they find here before they find their own.
        ctypes.CDLL(str(core), ctypes.RTLD_GLOBAL)
        ctypes.CDLL(str(library), ctypes.RTLD_GLOBAL)


def device() -> AbstractContextManager[Record]:
    """While this is open, `torch.device("cuda")` exists and gsplat is there; gives the record of what it does."""
    from .tensors import pretend

    return pretend()
