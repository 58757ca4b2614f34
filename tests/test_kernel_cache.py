"""Compiled kernels are kept as long as none of the files changes that they may be made of."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from wildgs import kernel_cache
from wildgs.errors import WildGSWarning

SHARED = """
from wildgs.kernel_cache import njit

@njit(nogil=True)
def factor():
    return {factor}
"""
KERNEL = """
import sys
from wildgs.kernel_cache import njit
from {package}.shared import factor

@njit(nogil=True)
def scaled(x):
    return x * factor()

print(scaled(21), sum(scaled.stats.cache_hits.values()))
"""


def run(folder: Path) -> list[int]:
    """The kernel's result in a new process, and how often it came from the cache."""
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", "import kernels.kernel"],
        capture_output=True, text=True, cwd=folder,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    return [int(value) for value in done.stdout.split()]


def write_package(folder: Path, kernel: str = KERNEL) -> Path:
    """A package `kernels` of a kernel that calls another file's function."""
    package = folder / "kernels"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "kernel.py").write_text(kernel.format(package="kernels"))
    (package / "shared.py").write_text(SHARED.format(factor=2))
    return package


def test_an_edit_of_a_file_that_a_kernel_calls_is_noticed(tmp_path: Path):
    package = write_package(tmp_path)
    assert run(tmp_path) == [42, 0]
    assert run(tmp_path) == [42, 1]
    (package / "shared.py").write_text(SHARED.format(factor=3))
    assert run(tmp_path) == [63, 0], "old code ran"


def test_of_two_processes_that_start_at_once_one_compiles(tmp_path: Path):
    waiting = "import time\nwhile time.time() < float(sys.argv[1]):\n    pass\n"
    write_package(tmp_path, KERNEL.replace("print(", waiting + "print(", 1))
    command = [sys.executable, "-W", "error", "-c", "import kernels.kernel", str(time.time() + 6)]
    both = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=tmp_path) for _ in range(2)]
    found = sorted(process.communicate(timeout=120)[0].split() for process in both)
    assert found == [["42", "0"], ["42", "1"]]


FORKED = """
import os
import kernels.kernel as made
child = os.fork()
if child == 0:
    print(made.scaled(2.5), flush=True)
    os._exit(0)
assert os.waitpid(child, 0)[1] == 0
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")
def test_a_forked_process_compiles_what_its_parent_has_not(tmp_path: Path):
    """The parent has compiled the kernel for integers, and so has made and used its lock."""
    write_package(tmp_path)
    done = subprocess.run(
        [sys.executable, "-c", FORKED], capture_output=True, text=True, cwd=tmp_path, timeout=120
    )
    assert done.returncode == 0, done.stderr
    assert "5.0" in done.stdout.splitlines()  # what the parent has not flushed follows


def test_where_nothing_is_writable_a_temporary_folder_serves_with_one_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    writable = kernel_cache._is_writable
    monkeypatch.setattr(kernel_cache, "_is_writable", lambda folder: False)
    kernel_cache.cache_folder.cache_clear()
    kernel_cache._temporary_folder.cache_clear()
    try:
        with pytest.warns(WildGSWarning, match="NUMBA_CACHE_DIR"):
            first = kernel_cache.cache_folder(tmp_path / "a")
        assert kernel_cache.cache_folder(tmp_path / "b") == first, (
            "no second warning, which would be an error"
        )
        assert first is not None
        assert writable(first)
    finally:
        kernel_cache.cache_folder.cache_clear()
        kernel_cache._temporary_folder.cache_clear()
