"""Work that people at the screen ask for: of each kind only the newest request counts."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable

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
