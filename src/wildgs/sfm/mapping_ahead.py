"""Runs of incremental mapping in processes of their own, ahead of where their models are needed.

COLMAP's mapper uses one core most of the time, and pycolmap holds Python's lock while it runs, so that threads are
no faster. How many runs are needed depends on the models of those before; the others are stopped.
"""

from __future__ import annotations

import json
import queue
import subprocess
import sys
import tempfile
from collections import deque
from collections.abc import Generator, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import pycolmap

from wildgs.progress import Progress
from wildgs.sfm.config import SfmConfig
from wildgs.sfm.mapping import map_photos
from wildgs.sfm.workplace import Workplace
from wildgs.threads import thread_count

MOST_PROCESSES = 4
"""Upper bound on processes, of which each keeps features and matches of all photos in memory."""

LEAST_PHOTOS = 16
"""Number of photos from which processes are worth starting, for which they take two to three seconds."""

SECONDS_BETWEEN = 0.2
"""Time between two reports of progress."""


@dataclass(frozen=True)
class MappingRun:
    """A run of incremental mapping.

    Attributes:
        seed: Random seed.
        wide: Whether photos may be distorted like those of action cameras and fisheye lenses.
        pair: Ids of the images to start with; None if COLMAP chooses.
    """

    seed: int
    wide: bool = False
    pair: tuple[int, int] | None = None


def map_each(
    work: Workplace,
    count: int,
    config: SfmConfig,
    progress: Progress,
    only: Sequence[str],
    runs: Iterable[MappingRun],
    *,
    ahead: bool = True,
) -> Generator[tuple[MappingRun, list[Any]]]:
    """Yields runs in their order with their models, largest first, and computes the next ones meanwhile.

    Args:
        work: The workplace.
        count: Number of all photos.
        config: Options; the seed is that of each run.
        progress: Called for the photos of the run that is waited for.
        only: Names of the working copies to map; empty for all.
        runs: The runs; taken as late as possible.
        ahead: Whether the next runs may be computed meanwhile; False where they are rarely needed.
    """
    total = config.threads if config.threads > 0 else thread_count()
    processes = min(total, MOST_PROCESSES)
    if not ahead or processes < 2 or (len(only) or count) < LEAST_PHOTOS or not sys.executable:
        for run in runs:
            yield run, _map_here(work, count, config, progress, only, run)
        return
    others = _Ahead(work, replace(config, threads=total // processes), count, only)
    pending: deque[tuple[MappingRun, Future[list[Any]]]] = deque()
    remaining = iter(runs)
    try:
        others.start(processes)
        while True:
            # One more than processes, so that none is idle while the caller looks at a model.
            while len(pending) <= processes and (run := next(remaining, None)) is not None:
                pending.append((run, others.submit(run)))
            if not pending:
                return
            run, models = pending.popleft()
            found = others.wait(run, models, progress)
            yield run, _map_here(work, count, config, progress, only, run) if found is None else found
    finally:
        others.stop()


def _map_here(
    work: Workplace, count: int, config: SfmConfig, progress: Progress, only: Sequence[str], run: MappingRun
) -> list[Any]:
    seeded = replace(config, seed=run.seed)
    return map_photos(work, count, seeded, progress, only, wide=run.wide, pair=run.pair)


class _FailedError(RuntimeError):
    """A process ended before its run."""


@dataclass
class _Ahead:
    """Processes that map, each with a thread that waits for it.

    Attributes:
        work: The workplace.
        config: Options, with the number of threads of one process.
        count: Number of all photos.
        only: Names of the working copies to map; empty for all.
        processes: All processes.
        idle: Those without a run.
        photos: Number of photos that each run has registered so far.
    """

    work: Workplace
    config: SfmConfig
    count: int
    only: Sequence[str]
    processes: list[subprocess.Popen[str]] = field(default_factory=list)
    idle: queue.SimpleQueue[subprocess.Popen[str]] = field(default_factory=queue.SimpleQueue)
    photos: dict[MappingRun, int] = field(default_factory=dict)
    _threads: ThreadPoolExecutor | None = None

    def start(self, number: int) -> None:
        """Starts the processes."""
        command = [sys.executable, "-m", "wildgs.sfm.mapping_process", str(self.work.root)]
        for _ in range(number):
            # Without errors: if it fails, the run is repeated here, which says why.
            process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
            )
            self.processes.append(process)
            self.idle.put(process)
        self._threads = ThreadPoolExecutor(number, thread_name_prefix="wildgs-mapping")

    def submit(self, run: MappingRun) -> Future[list[Any]]:
        """Has a run computed as soon as a process is idle."""
        assert self._threads is not None
        return self._threads.submit(self._compute, run)

    def wait(self, run: MappingRun, models: Future[list[Any]], progress: Progress) -> list[Any] | None:
        """The models of a run; None if its process failed."""
        progress("finding poses", 0, self.count)
        while not wait([models], SECONDS_BETWEEN).done:
            progress("finding poses", min(self.photos.get(run, 0), self.count), self.count)
        try:
            return models.result()
        except (OSError, ValueError, RuntimeError):
            return None

    def stop(self) -> None:
        """Ends all processes and threads."""
        for process in self.processes:
            process.kill()
        if self._threads is not None:
            self._threads.shutdown(wait=True, cancel_futures=True)
        for process in self.processes:
            with suppress(OSError), process:  # closes the pipes, one of which may have unsent input
                process.wait()

    def _compute(self, run: MappingRun) -> list[Any]:
        process = self.idle.get()
        try:
            with tempfile.TemporaryDirectory(prefix="run-", dir=self.work.root) as folder:
                self._ask(process, run, folder)
                places = sorted(Path(folder).iterdir(), key=lambda place: int(place.name))
                return [pycolmap.Reconstruction(place) for place in places]
        finally:
            self.idle.put(process)

    def _ask(self, process: subprocess.Popen[str], run: MappingRun, folder: str) -> None:
        assert process.stdin is not None
        assert process.stdout is not None
        order = {
            "config": asdict(replace(self.config, seed=run.seed)),
            "run": asdict(run),
            "count": self.count,
            "only": list(self.only),
            "folder": folder,
        }
        process.stdin.write(json.dumps(order) + "\n")
        process.stdin.flush()
        for line in process.stdout:
            if line.strip() == "done":
                return
            self.photos[run] = int(line)
        raise _FailedError("the process ended")
