"""Trains one run in a process of its own while the caller trains another.

At the size of the demo's photos, two threads train hardly faster than one, so that two trainings side by side take
little longer than the longer one of them.
"""

from __future__ import annotations

import contextlib
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from wildgs.config import ExecutionConfig, RunConfig
from wildgs.config_file import write_config
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
    with contextlib.ExitStack() as limits, tempfile.TemporaryDirectory(prefix="wildgs-") as place:
        file = Path(place) / "config.yaml"
        write_config(file, config)
        command = [sys.executable, "-m", "wildgs.library.side_process", str(file), str(folder), str(share)]
        # Without output: if it fails, the caller's own training reports why.
        process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
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
