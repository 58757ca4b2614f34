"""Trains one run in a process of its own while the caller trains another.

At the size of the demo's photos, two threads train hardly faster than one, so that two trainings side by side take
little longer than the longer one of them.
"""

from __future__ import annotations

import contextlib
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from wildgs.config import ExecutionConfig, RunConfig
from wildgs.config_file import config_text
from wildgs.runs import default_device
from wildgs.threads import kernels_limited, limited, thread_count

SECONDS_TO_SAVE = 20.0
"""How long an interrupted training may take to save its last step."""


@contextmanager
def training_beside(
    config: RunConfig, folder: Path, execution: ExecutionConfig
) -> Iterator[tuple[Callable[[object], None], subprocess.Popen[bytes] | None]]:
    """Trains a run in another process during the block, on a quarter of the threads and at least one.

    It is an optimisation only: the caller continues or repeats the training afterwards, which finds a finished run
    unless the process has failed. There is no process on a GPU, with a single thread, or where Python is
    embedded in another program.

    Args:
        config: Configuration of the run.
        folder: The run folder; training is resumed if it contains a run.
        execution: Execution of both trainings; its number of threads is divided between them.

    Yields:
        An observer for the training in this process, whose kernels get all threads when the process has ended, and
        the process, or None. Torch keeps its threads: at this size more of them gain little, and lose several times
        as much while other programs use the cores.
    """
    total = execution.threads or thread_count()
    if default_device().type != "cpu" or total < 2 or not sys.executable:
        yield (lambda _: None), None
        return
    share = max(1, total // 4)
    with contextlib.ExitStack() as limits:
        process = _start(config, folder, share)
        limits.enter_context(limited(total - share))

        widened = False

        def widen(_: object) -> None:
            nonlocal widened
            if not widened and process.poll() is not None:
                widened = True
                limits.enter_context(kernels_limited(total))

        try:
            yield widen, process
        finally:
            if process.poll() is None:
                process.terminate()
                try:
                    process.wait(SECONDS_TO_SAVE)
                except subprocess.TimeoutExpired:
                    process.kill()
                    process.wait()


def _start(config: RunConfig, folder: Path, threads: int) -> subprocess.Popen[bytes]:
    """Starts the process, which reads its configuration from its standard input.

    A temporary file would remain if this process was killed. There is no output: if the other process fails, the
    caller's own training reports why.
    """
    command = [sys.executable, "-m", "wildgs.library.side_process", str(folder), str(threads)]
    process = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    assert process.stdin is not None
    with contextlib.suppress(OSError), process.stdin as pipe:
        pipe.write(config_text(config).encode())
    return process
