"""The viewer's turns while training runs: short, rare, and only when someone looks."""

from __future__ import annotations

import time
from collections.abc import Callable

from wildgs.engine.trainer import StepReport
from wildgs.viewer.jobs import Jobs

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
