"""Process-wide settings that training changes and restores."""

from __future__ import annotations

import ctypes
import sys
from contextlib import ExitStack

import torch
from torch import Tensor

from wildgs.processes import library_environment

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # malloc.h of glibc
_MMAP_BYTES, _KEPT_BYTES = 2**25, 2**30  # 32 MiB is glibc's maximum of the first
_DEFAULT_BYTES = 128 * 2**10


class ProcessSettings:
    """Settings of the process and states of torch's random generators between `begin` and `end`.

    The generators' states are copied at construction, so that a seed set before applies to training.
    """

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self._random = _random_states(device)
        self._undo: ExitStack | None = None

    def begin(self) -> None:
        """Applies the settings of training if they are not applied yet."""
        if self._undo is not None:
            return
        undo = ExitStack()
        undo.enter_context(library_environment())
        undo.callback(_set_random_states, self.device, _random_states(self.device))
        _set_random_states(self.device, self._random)
        if self.device.type == "cpu":
            # Adam's moments of parameters without gradients decay into denormals, which are up to 100 times slower.
            undo.callback(torch.set_flush_denormal, _flushes_denormals())
            torch.set_flush_denormal(True)
            _keep_freed_memory(True)
            undo.callback(_keep_freed_memory, False)
        self._undo = undo

    def end(self) -> None:
        """Restores the settings before `begin`."""
        if self._undo is not None:
            self._random = _random_states(self.device)
            self._undo.close()
            self._undo = None

    def random_states(self) -> dict[str, Tensor]:
        """States of the random generators of training: `torch`, and on CUDA `cuda`."""
        return self._random if self._undo is None else _random_states(self.device)

    def set_random_states(self, states: dict[str, Tensor]) -> None:
        """Restores the result of `random_states`, possibly on another device."""
        self._random = self._random | {name: states[name] for name in self._random if name in states}
        if self._undo is not None:
            _set_random_states(self.device, self._random)


def _random_states(device: torch.device) -> dict[str, Tensor]:
    states = {"torch": torch.get_rng_state()}
    if device.type == "cuda":
        states["cuda"] = torch.cuda.get_rng_state(device)
    return states


def _set_random_states(device: torch.device, states: dict[str, Tensor]) -> None:
    torch.set_rng_state(states["torch"])
    if device.type == "cuda":
        torch.cuda.set_rng_state(states["cuda"], device)


def _flushes_denormals() -> bool:
    return float(torch.full((1,), 1e-40).mul(1.0)) == 0


def _keep_freed_memory(keep: bool) -> None:
    """Makes glibc's malloc keep freed memory: returning it costs a page fault per 4 KiB in every step."""
    if sys.platform != "linux":
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_MMAP_THRESHOLD, _MMAP_BYTES if keep else _DEFAULT_BYTES)
        mallopt(_M_TRIM_THRESHOLD, _KEPT_BYTES if keep else _DEFAULT_BYTES)
