"""The trainer's interface to the processes that train one model; `distributed` implements it for several."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TypeVar

import torch
from torch import Tensor

from wildgs.engine.density import ViewStatistics
from wildgs.errors import UserError
from wildgs.losses.objective import Losses
from wildgs.model.method import Method
from wildgs.scene import View
from wildgs.version import __version__

Result = TypeVar("Result")


class LostRankError(UserError):
    """Another process of this training ended or does not answer."""


class DivergedRanksError(UserError):
    """The ranks no longer hold the same model."""


class Team:
    """The processes (ranks) that train one model. This base class stands for a single process.

    Attributes:
        rank: Rank of this process.
        size: Number of processes.
        received_signal: Signal that asked this process to stop, 0 for none; sent to all ranks in the next step.
    """

    rank: int = 0
    size: int = 1

    def __init__(self) -> None:
        self.received_signal = 0

    @property
    def first(self) -> bool:
        """Whether this is rank 0, the only one that writes files and prints."""
        return self.rank == 0

    @property
    def stop_signal(self) -> int:
        """The signal because of which all ranks stop after this step, 0 for none; the same on all ranks."""
        return self.received_signal

    @contextmanager
    def propagate_errors(self) -> Iterator[None]:
        """Runs a block on all ranks: only rank 0 warns, and a `UserError` on any rank stops all of them.

        The block must not communicate between ranks.

        Raises:
            UserError: On rank 0; the message names the rank that failed.
            ReportedError: On the other ranks.
        """
        yield

    def from_first(self, function: Callable[[], Result]) -> Result:
        """Calls a function on rank 0 only and broadcasts its result; errors as in `propagate_errors`."""
        return function()

    def least(self, value: int) -> int:
        """The minimum over all ranks."""
        return value

    def require_same(self, facts: Mapping[str, str]) -> None:
        """Raises `UserError` if the ranks differ in one of these facts."""

    def share(self, tensors: Iterable[Tensor]) -> None:
        """Broadcasts rank 0's values to all ranks, in place."""

    def average(self, parameters: Iterable[Tensor], losses: Losses) -> Losses:
        """Replaces gradients by their means over the ranks; returns the mean losses, detached.

        A gradient that is missing on some ranks counts as zero there.

        Raises:
            LostRankError: A rank ended or does not answer.
            DivergedRanksError: The ranks' models differ in size.
        """
        return losses

    def pool(self, statistics: ViewStatistics) -> ViewStatistics:
        """Combines the statistics of all ranks by sums and maxima.

        Raises:
            LostRankError: A rank ended or does not answer.
        """
        return statistics

    def exchange(self, label: int, value: Tensor) -> list[tuple[int, Tensor]]:
        """The labels and values of all ranks, in order of the ranks; values have the same shape and type.

        Raises:
            LostRankError: A rank ended or does not answer.
        """
        return [(label, value)]


def same_everywhere(
    method: Method, views: Sequence[View], config: object, precision: torch.dtype
) -> dict[str, str]:
    """Properties that must be the same on all ranks before training, for `Team.require_same`."""
    shapes = {name: tuple(value.shape) for name, value in method.state_dict().items()}
    return {
        "version of wildgs": __version__,
        "version of torch": torch.__version__,
        "kind of device": method.gaussians.means.device.type,
        "precision": str(precision),
        "photos to train on": f"{len(views)} (checksum {_checksum(views)})",
        "number of Gaussians": f"{len(method.gaussians):,}",
        "model": f"{type(method).__name__} (checksum {_checksum(shapes)})",
        "settings": f"checksum {_checksum(config)}",
    }


def _checksum(value: object) -> str:
    return f"{zlib.crc32(repr(value).encode()):08x}"
