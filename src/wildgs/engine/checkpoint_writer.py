"""Checkpoints of a training on a GPU, written while it goes on."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from wildgs.engine.checkpoint import save_checkpoint
from wildgs.errors import UserError


class CheckpointWriter:
    """Writes checkpoints; in the background, only copying the state to main memory makes training wait.

    Attributes:
        background: Whether a thread writes. On the CPU it would take a core from training.
    """

    def __init__(self, background: bool) -> None:
        self.background = background
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="wildgs-checkpoint") if background else None
        self._pending: Future[Path] | None = None
        self._copies: dict[str, Tensor] = {}

    def save(self, folder: Path, step: int, state: dict[str, Tensor], header: dict[str, Any]) -> None:
        """Writes a checkpoint as `save_checkpoint` does, once the one before is written.

        Raises:
            UserError: This checkpoint, or in the background the one before it, could not be written.
        """
        if self._thread is None or not self.background:
            save_checkpoint(folder, step, state, header)
            return
        self.wait()
        self._pending = self._thread.submit(save_checkpoint, folder, step, self._copied(state), header)

    def wait(self) -> None:
        """Returns when nothing is left to write.

        Raises:
            UserError: The last checkpoint could not be written.
        """
        pending, self._pending = self._pending, None
        if pending is not None:
            pending.result()

    def finish(self) -> bool:
        """Waits, and writes what follows at once; whether the last checkpoint was written."""
        self.background = False
        try:
            self.wait()
        except UserError:
            return False
        return True

    def _copied(self, state: dict[str, Tensor]) -> dict[str, Tensor]:
        """The state in main memory; page-locked for tensors on a GPU, and kept for the next checkpoint."""
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
