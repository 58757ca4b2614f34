"""The standard streams of the process: closed ones, and readers that go away."""

from __future__ import annotations

import contextlib
import io
import os
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

STREAMS = (("stdin", "r"), ("stdout", "w"), ("stderr", "w"))
MIN_COLUMNS = 40
"""Narrowest help; in a few columns, tyro would never finish to wrap it."""


def prepare_streams() -> None:
    """Opens those standard streams that are closed, as under cron, and makes both outputs accept all file names."""
    for number in range(len(STREAMS)):
        _open_descriptor(number)
    for name, mode in STREAMS:
        if getattr(sys, name) is None:
            setattr(sys, name, Path(os.devnull).open(mode))  # noqa: SIM115  # open until the process ends
    for stream in (sys.stdout, sys.stderr):  # file names need not be valid UTF-8
        if isinstance(stream, io.TextIOWrapper):
            with contextlib.suppress(OSError):
                stream.reconfigure(errors="backslashreplace")


def _open_descriptor(number: int) -> None:
    """Opens the null device at a closed descriptor, which the next file to be opened would get otherwise."""
    try:
        os.fstat(number)
    except OSError:
        opened = os.open(os.devnull, os.O_RDWR)
        if opened != number:
            os.dup2(opened, number)
            os.close(opened)
        os.set_inheritable(number, True)


def flush_stdout() -> None:
    """Flushes stdout; raises only if its reader has closed it."""
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        raise
    except (OSError, ValueError):
        pass  # discarded by `flush_streams`


def stdout_is_closed() -> bool:
    """Whether the reader of stdout has closed it; if so, further output is discarded."""
    try:
        print(flush=True)
    except BrokenPipeError:
        discard_output(sys.stdout)
        return True
    return False


def flush_streams() -> None:
    """Flushes both streams; if that fails, discards the output so that Python's own flush at exit succeeds."""
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except (OSError, ValueError):
            discard_output(stream)


def discard_output(stream: Any) -> None:
    """Discards what is left in a stream's buffer, and all further output to it."""
    with contextlib.suppress(OSError, ValueError, AttributeError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


@contextmanager
def readable_width() -> Iterator[None]:
    """Lets help and error messages be at least `MIN_COLUMNS` wide for the duration of the block."""
    before = os.environ.get("COLUMNS")
    if shutil.get_terminal_size().columns < MIN_COLUMNS:
        os.environ["COLUMNS"] = str(MIN_COLUMNS)
    try:
        yield
    finally:
        if before is None:
            os.environ.pop("COLUMNS", None)
        else:
            os.environ["COLUMNS"] = before
