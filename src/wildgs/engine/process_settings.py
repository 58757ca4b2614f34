"""Process-wide settings that training changes and restores."""

from __future__ import annotations

from contextlib import ExitStack

import torch
from torch import Tensor

from wildgs.processes import freed_memory_kept, library_environment


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
            undo.enter_context(freed_memory_kept())
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
