"""Signals that end a training: the first finishes the step and saves, the second stops at once."""

from __future__ import annotations

import contextlib
import logging
import signal
import threading
from types import FrameType, TracebackType
from typing import Any

from wildgs.engine.team import Team
from wildgs.engine.trainer import StepReport

SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
"""Ctrl-C, the end of a cluster's time slot, and a terminal that was closed."""

logger = logging.getLogger("wildgs")


class InterruptedTrainingError(KeyboardInterrupt):
    """Training stopped because it was asked to; everything is saved.

    Attributes:
        code: The process's exit code by the shell's convention, 128 + signal.
    """

    def __init__(self, message: str, number: int) -> None:
        super().__init__(message)
        self.code = 128 + number


class StopOnSignal:
    """An observer of training that ends it between two steps once a signal has come."""

    def __init__(self, team: Team | None = None) -> None:
        """Sets up a `StopOnSignal`.

        Args:
            team: The processes that train together: all of them end after the same step.
        """
        self.team = team or Team()
        self.received: int | None = None
        self._previous: dict[int, Any] = {}

    def __enter__(self) -> StopOnSignal:
        if threading.current_thread() is threading.main_thread():  # Python allows handlers there alone
            for number in SIGNALS:
                if signal.getsignal(number) is not signal.SIG_IGN:  # as under nohup
                    self._previous[number] = signal.signal(number, self._receive)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def _receive(self, number: int, _: FrameType | None) -> None:
        if self.received is not None:
            if number == getattr(signal, "SIGHUP", None):
                return  # a closed terminal sends it to every process of a group, more than once
            raise KeyboardInterrupt
        self.received = self.team.received_signal = number
        with contextlib.suppress(OSError, RuntimeError):  # the signal may have come in the middle of a write
            logger.info("stopping after this step, then saving; a second signal stops at once, unsaved")

    def __call__(self, report: StepReport) -> None:
        """Ends training if a signal has come.

        Raises:
            InterruptedTrainingError: It has.
        """
        if self.team.stop_signal:
            raise InterruptedTrainingError(f"interrupted at step {report.step}", self.team.stop_signal)
