"""The process: its place among those of torchrun, signals that end it, its environment; imports little."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

LIBRARY_DEFAULTS = {
    # oneDNN compiles a convolution or matrix product for every size and keeps the last 1,024. A collection of
    # photos of many sizes needs more: two thirds of every step went into compiling again.
    "ONEDNN_PRIMITIVE_CACHE_CAPACITY": "8192",
    # By default MKL's order of addition depends on where in memory a matrix lies, and two equal trainings, or one
    # that was resumed, differ in the last bit.
    "MKL_CBWR": "AUTO,STRICT",
}


@contextmanager
def library_environment() -> Iterator[None]:
    """Sets `LIBRARY_DEFAULTS` where the environment has no value of its own, for as long as the block runs.

    oneDNN and MKL read them at their first call in the process and never again.
    """
    added = [name for name in LIBRARY_DEFAULTS if name not in os.environ]
    os.environ.update({name: LIBRARY_DEFAULTS[name] for name in added})
    try:
        yield
    finally:
        for name in added:
            os.environ.pop(name, None)


ENDING_SIGNALS = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))


class TerminatedError(KeyboardInterrupt):
    """The process was asked to end.

    An interrupt, so that whatever is temporary is removed on the way out.

    Attributes:
        code: The process's exit code by the shell's convention, 128 + signal.
    """

    def __init__(self, number: int) -> None:
        super().__init__("terminated")
        self.code = 128 + number


@contextmanager
def signals_as_interrupts() -> Iterator[None]:
    """Has SIGTERM and SIGHUP raise `TerminatedError` in the block; the second one ends the process at once.

    Signals that the process ignores (nohup) stay ignored. Outside the main thread, where Python allows no handlers,
    nothing changes.
    """
    previous: dict[int, Any] = {}

    def end(number: int, _: FrameType | None) -> None:
        for other in previous:
            signal.signal(other, signal.SIG_DFL)
        raise TerminatedError(number)

    if threading.current_thread() is threading.main_thread():
        for number in ENDING_SIGNALS:
            if signal.getsignal(number) is not signal.SIG_IGN:
                # Also where Python's handler is the same: pycolmap sets one of its own, which prints a C++ stack.
                previous[number] = signal.signal(number, end)
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)


def world_size() -> int:
    """How many processes were started together; 1 without torchrun."""
    return int(os.environ.get("WORLD_SIZE", "1")) if "RANK" in os.environ else 1


def rank() -> int:
    """This process's number among all, from 0."""
    return int(os.environ["RANK"]) if world_size() > 1 else 0


def local_rank() -> int:
    """This process's number among those on this machine, from 0."""
    return int(os.environ.get("LOCAL_RANK", "0")) if world_size() > 1 else 0


def local_world_size() -> int:
    """How many of the processes run on this machine."""
    return max(1, int(os.environ.get("LOCAL_WORLD_SIZE", "1"))) if world_size() > 1 else 1
