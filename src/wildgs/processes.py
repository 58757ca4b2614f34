"""The process: its rank under torchrun, signal handlers and environment variables. Imports no heavy package."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

LIBRARY_DEFAULTS = {
    # oneDNN compiles a primitive for every tensor shape and caches 1,024 of them. Photos of many sizes need more:
    # two thirds of every step were spent on compiling again.
    "ONEDNN_PRIMITIVE_CACHE_CAPACITY": "8192",
    # By default MKL's order of summation depends on memory alignment, so that repeated or resumed trainings would
    # differ in the last bit.
    "MKL_CBWR": "AUTO,STRICT",
}


@contextmanager
def library_environment() -> Iterator[None]:
    """Sets those environment variables of `LIBRARY_DEFAULTS` that are not set, for the duration of the block.

    oneDNN and MKL read them once, at their first call in the process.
    """
    added = [name for name in LIBRARY_DEFAULTS if name not in os.environ]
    os.environ.update({name: LIBRARY_DEFAULTS[name] for name in added})
    try:
        yield
    finally:
        for name in added:
            os.environ.pop(name, None)


_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # malloc.h of glibc
_MMAP_BYTES, _KEPT_BYTES = 2**25, 2**30  # 32 MiB is glibc's maximum of the first
_DEFAULT_BYTES = 128 * 2**10

_keeping: list[None] = []
"""One entry for each active block of `freed_memory_kept`, which may overlap."""


@contextmanager
def freed_memory_kept() -> Iterator[None]:
    """Makes glibc's malloc keep freed memory for the duration of the block; blocks may be nested or overlap.

    Returning large arrays to the operating system costs a page fault per 4 KiB at their next allocation.
    """
    _keeping.append(None)
    if len(_keeping) == 1:
        _set_malloc(_MMAP_BYTES, _KEPT_BYTES)
    try:
        yield
    finally:
        _keeping.pop()
        if not _keeping:
            _set_malloc(_DEFAULT_BYTES, _DEFAULT_BYTES)


def _set_malloc(mmap_bytes: int, trim_bytes: int) -> None:
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if mallopt is not None:
        mallopt(_M_MMAP_THRESHOLD, mmap_bytes)
        mallopt(_M_TRIM_THRESHOLD, trim_bytes)


ENDING_SIGNALS = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))


class TerminatedError(KeyboardInterrupt):
    """The process received a signal to terminate.

    A `KeyboardInterrupt`, so that temporary files are removed as after Ctrl-C.

    Attributes:
        code: Exit code by the shell's convention, 128 + signal number.
    """

    def __init__(self, number: int) -> None:
        super().__init__("terminated")
        self.code = 128 + number


@contextmanager
def signals_as_interrupts() -> Iterator[None]:
    """Makes SIGTERM and SIGHUP raise `TerminatedError` in the block; a second signal kills the process.

    Signals that the process ignores (nohup) stay ignored. Does nothing outside the main thread, where Python does
    not allow signal handlers.
    """
    previous: dict[int, Any] = {}

    def end(number: int, _: FrameType | None) -> None:
        for other in previous:
            signal.signal(other, signal.SIG_DFL)
        raise TerminatedError(number)

    if threading.current_thread() is threading.main_thread():
        for number in ENDING_SIGNALS:
            if signal.getsignal(number) is not signal.SIG_IGN:
                # Unconditionally: pycolmap may have installed a C++ handler, which Python does not know of.
                previous[number] = signal.signal(number, end)
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)


def world_size() -> int:
    """Number of processes; 1 without torchrun."""
    return int(os.environ.get("WORLD_SIZE", "1")) if "RANK" in os.environ else 1


def rank() -> int:
    """Rank of this process among all processes."""
    return int(os.environ["RANK"]) if world_size() > 1 else 0


def local_rank() -> int:
    """Rank of this process among those on this machine."""
    return int(os.environ.get("LOCAL_RANK", "0")) if world_size() > 1 else 0


def local_world_size() -> int:
    """Number of processes on this machine."""
    return max(1, int(os.environ.get("LOCAL_WORLD_SIZE", "1"))) if world_size() > 1 else 1
