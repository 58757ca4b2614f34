"""Trains one run in a process of its own while the caller trains another: `python -m wildgs.library.side_training`.

At the size of the demo's photos, two threads train hardly faster than one, so that two trainings side by side take
little longer than the longer one of them.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from wildgs.config import ExecutionConfig, RunConfig, read_config, write_config
from wildgs.engine.trainer import Observer, StepReport
from wildgs.runs import default_device
from wildgs.threads import limited, thread_count

SECONDS_TO_SAVE = 20.0
"""How long an interrupted training may take to save its last step."""


@contextmanager
def training_beside(
    config: RunConfig, folder: Path, execution: ExecutionConfig
) -> Iterator[tuple[Observer, subprocess.Popen[bytes] | None]]:
    """Trains a run in another process during the block, on a quarter of the threads and at least one.

    It is an optimisation only: the caller continues or repeats the training afterwards, which finds a finished run
    unless the process has failed. There is no process on a GPU, with a single thread, or where Python is
    embedded in another program.

    Args:
        config: Configuration of the run.
        folder: The run folder; training is resumed if it contains a run.
        execution: Execution of both trainings; its number of threads is divided between them.

    Yields:
        An observer for the training in this process, which gets all threads when the process has ended, and the
        process, or None.
    """
    total = execution.threads or thread_count()
    if default_device().type != "cpu" or total < 2 or not sys.executable:
        yield (lambda _: None), None
        return
    share = max(1, total // 4)
    with contextlib.ExitStack() as limits, tempfile.TemporaryDirectory(prefix="wildgs-") as place:
        file = Path(place) / "config.yaml"
        write_config(file, config)
        command = [sys.executable, "-m", __name__, str(file), str(folder), str(share)]
        # Without output: if it fails, the caller's own training reports why.
        process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        limits.enter_context(limited(total - share))

        def widen(_: object) -> None:
            if process.poll() is not None:
                limits.close()

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


def main(config: str, folder: str, threads: str) -> None:
    """Trains until the end, or until the process that started this one has ended."""
    from wildgs.library.training import train

    parent = os.getppid()

    def stop_if_orphaned(report: StepReport) -> None:
        if os.getppid() != parent:
            raise KeyboardInterrupt

    read = read_config(Path(config))
    train(
        read.scene,
        read,
        output=folder,
        execution=ExecutionConfig(threads=int(threads)),
        resume="auto",
        observers=[stop_if_orphaned],
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
