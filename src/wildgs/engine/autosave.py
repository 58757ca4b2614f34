"""Checkpoints while training goes on: by steps and by time, and a full disk does not end the training."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass

from wildgs.engine.trainer import StepReport
from wildgs.errors import UserError, WildGSWarning

RETRY_SECONDS = 60.0


@dataclass(frozen=True)
class AutosaveConfig:
    """When checkpoints are written; whichever comes first. It has no influence on the result."""

    checkpoint_every: int = 1000
    """Steps between checkpoints."""
    checkpoint_minutes: float = 10.0
    """Minutes between checkpoints."""

    def __post_init__(self) -> None:
        """Refuses values that mean nothing."""
        if self.checkpoint_every < 1 or not self.checkpoint_minutes > 0:
            raise UserError("--checkpoint-every and --checkpoint-minutes must be above 0")


class Autosave:
    """An observer of training that saves what is worth saving.

    Steps that were skipped for a loss or gradient that is no number are not: nothing was learnt in them, and
    what made them fail may be in the parameters already.
    """

    def __init__(
        self, save: Callable[[], object], config: AutosaveConfig, step: int, *, least_seconds: float = 0.0
    ) -> None:
        """Sets up an `Autosave`.

        Args:
            save: Writes a checkpoint of the trainer's present state; raises `UserError` where it cannot.
            config: When.
            step: The step of the newest checkpoint.
            least_seconds: Time between two checkpoints, however many steps it is.
        """
        self._save = save
        self.config = config
        self.saved_step = step
        self._due = self._next_time()
        self._least_seconds = least_seconds
        self._saved_at = float("-inf")

    def _next_time(self) -> float:
        return time.monotonic() + 60 * self.config.checkpoint_minutes

    def __call__(self, report: StepReport) -> None:
        """Saves if it is time to; where that fails, warns and tries again a minute later."""
        rested = time.monotonic() - self._saved_at >= self._least_seconds
        on_step = rested and report.falls_on(self.config.checkpoint_every)
        if report.skipped is not None or not (on_step or time.monotonic() >= self._due):
            return
        try:
            self.save(report.step)
        except UserError as error:
            self._due = time.monotonic() + RETRY_SECONDS
            warnings.warn(f"{error} (training goes on and tries again)", WildGSWarning, stacklevel=2)

    def save(self, step: int) -> None:
        """Saves now, unless this step is saved already.

        Raises:
            UserError: It cannot be written.
        """
        if step > self.saved_step:
            self._save()
            self.saved_step = step
            self._saved_at = time.monotonic()
            self._due = self._next_time()
