"""The queue of the viewer's work, done by a thread of its own or between training steps."""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Callable

from wildgs.engine.trainer import StepReport

Job = Callable[[], None]


class Jobs:
    """Requests in the order in which their kinds were first asked for.

    A slider sends more values than can be shaded; a request replaces an older one of its kind that still waits.
    All work on the method goes through one such queue and is done by one thread: a worker's, or the trainer's.
    """

    def __init__(self) -> None:
        self._waiting: OrderedDict[str, Job] = OrderedDict()
        self._changed = threading.Condition()
        self._closed = False

    def put(self, kind: str, job: Job) -> None:
        """Asks for work; does nothing once the queue is closed."""
        with self._changed:
            if not self._closed:
                self._waiting[kind] = job
                self._changed.notify()

    def take(self, *, wait: bool) -> Job | None:
        """The next job.

        Args:
            wait: Until there is one; None then means that the queue was closed.
        """
        with self._changed:
            while wait and not self._waiting and not self._closed:
                self._changed.wait()
            return self._waiting.popitem(last=False)[1] if self._waiting else None

    def close(self) -> None:
        """Ends the queue: what waits is dropped, and whoever waits for work gets none."""
        with self._changed:
            self._closed = True
            self._waiting.clear()
            self._changed.notify_all()


def work_off(jobs: Jobs) -> None:
    """Does jobs as they come, until the queue is closed."""
    while (job := jobs.take(wait=True)) is not None:
        job()


def start_worker(jobs: Jobs) -> threading.Thread:
    """Works off the queue on a thread of its own.

    It ends when the queue is closed and the job in hand is done. A program must wait for that: a thread that Python
    stops in the middle of a kernel takes the whole process with it.
    """
    worker = threading.Thread(target=work_off, args=(jobs,), name="wildgs-viewer")
    worker.start()
    return worker


SHARE = 0.03
"""Part of the time that the viewer may take. It promises 5% at most; the rest covers what viser's own thread needs
to send what was made here."""
UPDATE_SECONDS = 3.0


class TrainingTurns:
    """An observer of training that does the viewer's work between steps, and rests after it.

    Parameters may only be read between steps, so the work is done on the trainer's thread. Work that took t seconds
    is followed by a rest of t (1 - share) / share, so its part of the time never grows beyond the share, however
    much the people at the screen ask for; they wait longer instead.
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
        """Sets up `TrainingTurns`.

        Args:
            jobs: Work that was asked for.
            watched: Whether any browser is connected.
            update: Asks for the present step to be shown.
            share: Part of the time that work may take.
            every: Seconds between updates, at least.
            clock: Seconds.
        """
        self.seconds = 0.0
        self._jobs, self._watched, self._update = jobs, watched, update
        self._share, self._every, self._clock = share, every, clock
        self._rest_until = self._next_update = clock()

    def __call__(self, report: StepReport) -> None:
        """Does one piece of work, if its time has come."""
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
