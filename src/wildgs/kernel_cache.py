"""Numba's `njit` with a disk cache whose key is a digest of all source files that a kernel may be compiled from.

Numba's own cache only checks the kernel's own file, so that outdated code would run after a change in another file
whose functions the kernel calls. It also fails if neither the package nor the home folder is writable, and several
processes that start at once would all compile every kernel.
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

import filelock
import numba
from numba.core import config
from numba.core.caching import CompileResultCacheImpl, FunctionCache, _CacheLocator

from wildgs.errors import WildGSWarning

_SHARED = ("threads.py", "kernel_cache.py", "rasterize/cpu/simd.py", "rasterize/cpu/simd_memory.py")
"""Files of the package that all kernels use."""


def njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """`numba.njit(**options)` with this module's cache, without the wrappers that only C code would call."""
    options = {"no_cfunc_wrapper": True} | options

    def decorate(function: Callable[..., Any]) -> Any:
        kernel: Any = numba.njit(**options)(function)
        if cache_folder(Path(function.__code__.co_filename).parent) is not None:
            kernel._cache = _KernelCache(function)
        return kernel

    return decorate


@cache
def source_digest(folder: Path) -> str:
    """SHA-256 of the Python files of a folder of kernels and of `_SHARED`."""
    package = Path(__file__).parent
    digest = hashlib.sha256()
    for file in [*sorted(folder.glob("*.py")), *(package / name for name in _SHARED)]:
        digest.update(f"\n{file.name}\n".encode())
        digest.update(file.read_bytes())
    return digest.hexdigest()


@cache
def cache_folder(folder: Path) -> Path | None:
    """The folder for the compiled kernels of a source folder; None if no folder is writable.

    The first writable one of `NUMBA_CACHE_DIR`, `__pycache__` in the source folder, and the user's cache folder. If
    there is none, warns and uses a temporary folder until the process ends.
    """
    for candidate in _candidates(folder):
        if _is_writable(candidate):
            return candidate
    return _temporary_folder()


def _candidates(folder: Path) -> Iterator[Path]:
    # The digest keeps the kernels of several installations apart.
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
        "neither the package's folder nor the home folder is writable, so every process compiles the CPU kernels "
        "again; set NUMBA_CACHE_DIR to a writable folder"
    )
    warnings.warn(message, WildGSWarning, stacklevel=5)
    try:
        folder = tempfile.mkdtemp(prefix="wildgs-kernels-")
    except OSError:
        return None
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return Path(folder)


class _Locator(_CacheLocator):
    """Provides Numba with the location and the key of a kernel's cache."""

    def __init__(self, function: Any, file: str) -> None:
        self._py_file = file  # read by Numba's warnings
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


LONGEST_COMPILATION = 120.0
"""Seconds after which a process no longer waits for another one that compiles the same kernel."""


class _KernelCache(FunctionCache):
    """Lets one process compile a kernel while others that need it wait, and then load it."""

    _impl_class = _Implementation

    def __init__(self, function: Any) -> None:
        super().__init__(function)
        name = f"{function.__qualname__}-{function.__code__.co_firstlineno}.lock"
        file = Path(self.cache_path) / "locks" / name.replace("<locals>", "")
        self._lock_file, self._locks = file, dict[int, filelock.BaseFileLock]()

    @property
    def _lock(self) -> filelock.BaseFileLock:
        """This process's lock; one that was made before a fork is of no use after it."""
        process = os.getpid()
        if process not in self._locks:
            self._locks = {process: filelock.FileLock(self._lock_file, timeout=LONGEST_COMPILATION)}
        return self._locks[process]

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The compiled kernel; if it is not on the disk, the lock is held until `save_overload`."""
        found = super().load_overload(sig, target_context)
        if found is not None or not self._begin():
            return found
        found = super().load_overload(sig, target_context)
        if found is not None:  # compiled by another process meanwhile
            self._lock.release()
        return found

    def save_overload(self, sig: Any, data: Any) -> None:
        """Writes a compiled kernel and releases the lock."""
        try:
            super().save_overload(sig, data)
        finally:
            self._lock.release(force=True)

    def _begin(self) -> bool:
        """Locks the kernel; False on a file system without locks, or if another process takes too long."""
        try:
            Path(self._lock.lock_file).parent.mkdir(parents=True, exist_ok=True)
            self._lock.acquire()
        except (OSError, NotImplementedError):  # `filelock.Timeout` is an OSError
            return False
        return True
