"""Numba's `njit` with a cache on disk, keyed by the digest of all files that a kernel may be compiled from.

Numba's own cache looks at the file of a kernel alone, so that after an edit of another file whose functions the
kernel calls the old code would run. It also fails where neither the package nor the home folder can be written to.
"""

from __future__ import annotations

import atexit
import hashlib
import os
import shutil
import tempfile
import warnings
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numba
from numba.core import config
from numba.core.caching import CompileResultCacheImpl, FunctionCache, _CacheLocator

from wildgs.errors import WildGSWarning

_SHARED = ("threads.py", "kernel_cache.py")
"""Files of the package that kernels of all folders use."""


def njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """`numba.njit(**options)` with this module's cache."""

    def decorate(function: Callable[..., Any]) -> Any:
        kernel: Any = numba.njit(**options)(function)
        if cache_folder(Path(function.__code__.co_filename).parent) is not None:
            kernel._cache = _KernelCache(function)
        return kernel

    return decorate


@cache
def source_digest(folder: Path) -> str:
    """SHA-256 over the Python files of a folder of kernels and those that kernels of all folders use."""
    package = Path(__file__).parent
    digest = hashlib.sha256()
    for file in [*sorted(folder.glob("*.py")), *(package / name for name in _SHARED)]:
        digest.update(f"\n{file.name}\n".encode())
        digest.update(file.read_bytes())
    return digest.hexdigest()


@cache
def cache_folder(folder: Path) -> Path | None:
    """Where the compiled kernels of a folder are kept; None where no disk can be written to.

    `NUMBA_CACHE_DIR` where it is set, else `__pycache__` beside the kernels, else the user's cache folder. Where
    none is writable, one warning is given and a temporary folder serves until the process ends.
    """
    for candidate in _candidates(folder):
        if _is_writable(candidate):
            return candidate
    return _temporary_folder()


def _candidates(folder: Path) -> Iterator[Path]:
    # Two installations must not overwrite each other's kernels.
    name = f"{folder.name}_{hashlib.sha1(str(folder).encode()).hexdigest()[:16]}"
    chosen = getattr(config, "CACHE_DIR", "")
    if chosen:
        yield Path(chosen) / name
    yield folder / "__pycache__"
    home = (
        os.environ.get("XDG_CACHE_HOME")
        or os.environ.get("LOCALAPPDATA")
        or str(Path("~/.cache").expanduser())
    )
    yield Path(home) / "wildgs" / name


def _is_writable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


@cache
def _temporary_folder() -> Path | None:
    message = (
        "neither the package's folder nor the home folder can be written to, so every process compiles the CPU "
        "kernels again; set NUMBA_CACHE_DIR to a folder that can be written to"
    )
    warnings.warn(message, WildGSWarning, stacklevel=5)
    try:
        folder = tempfile.mkdtemp(prefix="wildgs-kernels-")
    except OSError:
        return None
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return Path(folder)


class _Locator(_CacheLocator):
    """Tells Numba where a kernel's cache is and what it depends on."""

    def __init__(self, function: Any, file: str) -> None:
        self._py_file = file  # Numba reads it for warnings
        self._line = function.__code__.co_firstlineno

    def get_cache_path(self) -> str:
        return str(cache_folder(Path(self._py_file).parent))

    def get_source_stamp(self) -> str:
        return source_digest(Path(self._py_file).parent)

    def get_disambiguator(self) -> str:
        return str(self._line)

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> _Locator:
        return cls(py_func, py_file)


class _Implementation(CompileResultCacheImpl):
    _locator_classes = [_Locator]  # noqa: RUF012 - Numba's name


class _KernelCache(FunctionCache):
    _impl_class = _Implementation
