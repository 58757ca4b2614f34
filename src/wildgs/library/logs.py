"""The log file of a run, and signals during training: the first saves and stops, the second stops at once."""

from __future__ import annotations

import contextlib
import logging
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any

from wildgs.engine.report import StepReport
from wildgs.engine.team import Team
from wildgs.errors import UserError
from wildgs.files import check_regular, is_there

LOG_FILE = "train.log"

logger = logging.getLogger("wildgs")


@contextmanager
def run_log(folder: Path) -> Iterator[None]:
    """Appends log messages to the run's log file during the block; does nothing if it cannot be written."""
    logging.raiseExceptions = False  # no tracebacks of the logging module on a full disk
    try:
        if is_there(folder / LOG_FILE):
            check_regular(folder / LOG_FILE)  # opening a pipe would wait for its reader
        handler = logging.FileHandler(folder / LOG_FILE, encoding="utf-8", errors="backslashreplace")
    except OSError:
        yield
        return
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
    level = logger.level
    logger.addHandler(handler)
    logger.setLevel(logging.DEBUG)
    try:
        yield
    except UserError as error:
        logger.error("stopped: %s", error)
        raise
    except KeyboardInterrupt as error:
        logger.debug("%s", error or "interrupted")  # the caller reports it
        raise
    except Exception:
        logger.exception("training failed")
        raise
    finally:
        logger.removeHandler(handler)
        logger.setLevel(level)
        with contextlib.suppress(OSError):
            handler.close()


SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
"""Sent by Ctrl-C, by a cluster's scheduler at the time limit, and by a terminal that is closed."""


class InterruptedTrainingError(KeyboardInterrupt):
    """Training was stopped by a signal after saving; `code` is the process's exit code, 128 + signal number."""

    def __init__(self, message: str, number: int) -> None:
        super().__init__(message)
        self.code = 128 + number


class StopOnSignal:
    """An observer that stops training after the current step when a signal arrives, on all processes of a team."""

    def __init__(self, team: Team | None = None) -> None:
        self.team = team or Team()
        self.received: int | None = None
        self._previous: dict[int, Any] = {}

    def __enter__(self) -> StopOnSignal:
        if threading.current_thread() is threading.main_thread():  # Python allows signal handlers only there
            for number in SIGNALS:
                if signal.getsignal(number) is not signal.SIG_IGN:  # ignored under nohup
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
                return  # a closed terminal may send it several times
            raise KeyboardInterrupt
        self.received = self.team.received_signal = number
        with contextlib.suppress(OSError, RuntimeError):  # the signal may have interrupted a write
            logger.info("saving and stopping after this step; a second signal stops at once without saving")

    def __call__(self, report: StepReport) -> None:
        """Raises `InterruptedTrainingError` if a rank has received a signal."""
        if self.team.stop_signal:
            raise InterruptedTrainingError(f"interrupted at step {report.step}", self.team.stop_signal)
