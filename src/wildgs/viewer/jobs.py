"""The viewer's job queue, processed by a worker thread or between training steps."""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Callable

from wildgs.engine.report import StepReport

Job = Callable[[], None]


class Jobs:
    """A queue in which a job replaces an older one of the same kind, such as an outdated slider value.

    All work on the method goes through one queue and is done by one thread, a worker's or the trainer's.
    """

    def __init__(self) -> None:
        self._waiting: OrderedDict[str, Job] = OrderedDict()
        self._changed = threading.Condition()
        self._closed = False

    def put(self, kind: str, job: Job) -> None:
        """Adds a job unless the queue is closed."""
        with self._changed:
            if not self._closed:
                self._waiting[kind] = job
                self._changed.notify()

    def take(self, *, wait: bool) -> Job | None:
        """The next job; None if there is none or, with `wait`, if the queue is closed."""
        with self._changed:
            while wait and not self._waiting and not self._closed:
                self._changed.wait()
            return self._waiting.popitem(last=False)[1] if self._waiting else None

    def close(self) -> None:
        """Closes the queue and drops its jobs."""
        with self._changed:
            self._closed = True
            self._waiting.clear()
            self._changed.notify_all()


def start_worker(jobs: Jobs) -> threading.Thread:
    """Starts a thread that does jobs until the queue is closed.

    The caller must join it, because a thread that Python stops inside a kernel crashes the process.
    """

    def work() -> None:
        while (job := jobs.take(wait=True)) is not None:
            job()

    worker = threading.Thread(target=work, name="wildgs-viewer")
    worker.start()
    return worker


SHARE = 0.03
"""Fraction of the time that jobs may take. Together with viser's own thread the viewer takes less than 5%."""
UPDATE_SECONDS = 3.0


class TrainingTurns:
    """An observer of training that does the viewer's jobs between steps, on the trainer's thread.

    A job that took t seconds is followed by a pause of t (1 - share) / share, so that jobs never take more than
    that fraction of the time, whatever clients request.
    """

    def __init__(
        self,
        jobs: Jobs,
        watched: Callable[[], bool],
        update: Callable[[StepReport], None],
        *,
        share: float = SHARE,
        every: float = UPDATE_SECONDS,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        """Creates the observer.

        Args:
            jobs: The queue.
            watched: Whether any client is connected.
            update: Queues an update to the current step.
            share: Fraction of the time that jobs may take.
            every: Smallest time between updates, seconds.
            clock: Returns the time in seconds.
        """
        self.seconds = 0.0
        self._jobs, self._watched, self._update = jobs, watched, update
        self._share, self._every, self._clock = share, every, clock
        self._rest_until = self._next_update = clock()

    def __call__(self, report: StepReport) -> None:
        """Does at most one job."""
        now = self._clock()
        if now < self._rest_until or not self._watched():
            return
        if now >= self._next_update:
            self._next_update = now + self._every
            self._update(report)
        job = self._jobs.take(wait=False)
        if job is None:
            return
        job()
        spent = self._clock() - now
        self.seconds += spent
        self._rest_until = self._clock() + spent * (1 - self._share) / self._share
