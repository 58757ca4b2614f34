"""Checkpoints during training: periodic saving, writing in the background, retries when the disk is full."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from wildgs.engine.checkpoint import save_checkpoint
from wildgs.engine.report import StepReport
from wildgs.errors import UserError, WildGSWarning


class CheckpointWriter:
    """Writes checkpoints, with `background` in a thread, so that training only waits for the copy to the CPU.

    When training on the CPU, the thread would take a core from it.
    """

    def __init__(self, background: bool) -> None:
        self.background = background
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="wildgs-checkpoint") if background else None
        self._pending: Future[Path] | None = None
        self._copies: dict[str, Tensor] = {}

    def save(self, folder: Path, step: int, state: dict[str, Tensor], header: dict[str, Any]) -> None:
        """Writes a checkpoint by `save_checkpoint` after the previous one is finished.

        Raises:
            UserError: This checkpoint or, in the background, the previous one could not be written.
        """
        if self._thread is None or not self.background:
            save_checkpoint(folder, step, state, header)
            return
        self.wait()
        self._pending = self._thread.submit(save_checkpoint, folder, step, self._copied(state), header)

    def wait(self) -> None:
        """Waits for the checkpoint being written; raises its `UserError` if that fails."""
        pending, self._pending = self._pending, None
        if pending is not None:
            pending.result()

    def finish(self) -> bool:
        """Waits, and writes further checkpoints synchronously; returns whether the last one was written."""
        self.background = False
        try:
            self.wait()
        except UserError:
            return False
        return True

    def _copied(self, state: dict[str, Tensor]) -> dict[str, Tensor]:
        """Copies the state to the CPU, from a GPU into pinned buffers that are reused for the next checkpoint."""
        on_cuda = any(value.is_cuda for value in state.values())
        kept: dict[str, Tensor] = {}
        for name, value in state.items():
            copy = self._copies.get(name)
            if copy is None or (copy.shape, copy.dtype) != (value.shape, value.dtype):
                copy = torch.empty(value.shape, dtype=value.dtype, pin_memory=value.is_cuda)
            kept[name] = copy.copy_(value.detach(), non_blocking=True)
        if on_cuda:
            torch.cuda.synchronize()
        self._copies = kept
        return kept


RETRY_SECONDS = 60.0
LAST_TRIES, LAST_WAIT = 6, 10.0
"""Number of attempts to write the last checkpoint, and seconds between them."""


class Autosave:
    """An observer of training that saves checkpoints periodically.

    Nothing is saved after a step that was skipped for a non-finite loss or gradient, since parameters may be the
    cause.
    """

    def __init__(
        self,
        save: Callable[[], object],
        *,
        every: int = 1000,
        minutes: float = 10.0,
        step: int = 0,
        rescue: Callable[[], Path] | None = None,
        least_seconds: float = 0.0,
    ) -> None:
        """Creates the observer.

        Args:
            save: Writes a checkpoint of the trainer's current state; raises `UserError` on failure.
            every: Steps between checkpoints.
            minutes: Largest time between checkpoints, in minutes.
            step: The step of the newest checkpoint.
            rescue: Writes the state to another folder if the last checkpoint cannot be written to the run folder.
            least_seconds: Smallest time between checkpoints.
        """
        self._save, self._rescue = save, rescue
        self.every, self.minutes = every, minutes
        self.saved_step = step
        self._due = self._next_time()
        self._least_seconds = least_seconds
        self._saved_at = float("-inf")

    def _next_time(self) -> float:
        return time.monotonic() + 60 * self.minutes

    def __call__(self, report: StepReport) -> None:
        """Saves if a checkpoint is due; if that fails, warns and tries again a minute later."""
        old_enough = time.monotonic() - self._saved_at >= self._least_seconds
        on_step = old_enough and report.falls_on(self.every)
        if report.skipped is not None or not (on_step or time.monotonic() >= self._due):
            return
        try:
            self.save(report.step)
        except UserError as error:
            self._due = time.monotonic() + RETRY_SECONDS
            warnings.warn(f"{error} (training continues and tries again)", WildGSWarning, stacklevel=2)

    def save(self, step: int) -> None:
        """Saves now, unless this step is already saved.

        Raises:
            UserError: The checkpoint cannot be written.
        """
        if step > self.saved_step:
            self._save()
            self.saved_step = step
            self._saved_at = time.monotonic()
            self._due = self._next_time()

    def save_last(self, step: int, *, hurry: bool = False) -> None:
        """Saves the last step: tries for a minute, or once in a `hurry`, then writes it to another folder.

        Raises:
            UserError: It could not be written to the run folder; the message names the other folder.
        """
        left = 0 if hurry else LAST_TRIES - 1
        while True:
            try:
                return self.save(step)
            except UserError as error:
                failure = error
            if not left:
                break
            wait = f"{left * LAST_WAIT:.0f} s"
            warnings.warn(f"{failure} (trying again for {wait})", WildGSWarning, stacklevel=2)
            time.sleep(LAST_WAIT)
            left -= 1
        if self._rescue is None:
            raise failure
        try:
            place = self._rescue()
        except UserError:
            raise failure from None
        raise UserError(
            f"{failure}; step {step} was saved as {place} instead: free disk space, move this file into the run's "
            "checkpoints folder, then --resume"
        ) from failure
