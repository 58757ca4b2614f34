"""A device that says it is CUDA and computes on the CPU: counts what a GPU would be told to do, without one.

Tensors on it are real, so whole training steps run, and it counts how many kernels a step launches and where the
host waits for the device. It says nothing about times, streams, graph capture or gsplat's interface; tests check
those against torch and the installed gsplat.

    import pretend_cuda
    pretend_cuda.prepare()          # before torch is imported; needs g++
    with pretend_cuda.device() as record:
        ...                         # torch.device("cuda") exists in here

`prepare` gives a build of torch without CUDA the little that its autograd engine asks of an accelerator: that there
is one, and that it has one stream.
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
    from pretend_cuda.tensors import Record

SOURCE = Path(__file__).with_name("device.cpp")


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
    torch_folder = Path(spec.origin).parent
    if (torch_folder / "lib" / "libtorch_cuda.so").exists():
        raise SystemExit("this torch has CUDA itself; pretending is for builds that have not")
    core = torch_folder / "lib" / "libc10.so"
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder) / "device.so"
        flags = ["-std=c++20", "-O1", "-shared", "-fPIC", f"-I{torch_folder / 'include'}"]
        subprocess.run([compiler, *flags, str(SOURCE), "-o", str(library), str(core)], check=True)
        # First of all: what torch's libraries look up, they find here before they find their own.
        ctypes.CDLL(str(core), ctypes.RTLD_GLOBAL)
        ctypes.CDLL(str(library), ctypes.RTLD_GLOBAL)


def device() -> AbstractContextManager[Record]:
    """While this is open, `torch.device("cuda")` exists and gsplat is there; gives the record of what it does."""
    from pretend_cuda.tensors import pretend

    return pretend()
