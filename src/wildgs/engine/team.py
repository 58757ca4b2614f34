"""What the trainer knows of the other processes that train the same model (see `distributed`)."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TypeVar

import torch
from torch import Tensor

from wildgs.engine.density import ScreenStatistics
from wildgs.errors import UserError
from wildgs.losses.objective import Losses
from wildgs.model.method import Method
from wildgs.scene import View
from wildgs.version import __version__

Result = TypeVar("Result")


class LostRankError(UserError):
    """Another process of this training ended, or does not answer."""


class DivergedRanksError(UserError):
    """The ranks do not hold the same model any more."""


class Team:
    """The processes that train one model, as one of them sees it. This class: one process alone.

    Attributes:
        rank: This process, from 0.
        size: How many there are.
        wish: The signal by which this process was asked to stop, 0 for none; carried to all with the next step.
    """

    rank: int = 0
    size: int = 1

    def __init__(self) -> None:
        self.wish = 0

    @property
    def first(self) -> bool:
        """Whether this process writes files and talks to the user."""
        return self.rank == 0

    @property
    def verdict(self) -> int:
        """The signal by which all are to stop after this step, 0 for none; the same on all ranks."""
        return self.wish

    @contextmanager
    def together(self) -> Iterator[None]:
        """A block that all ranks run alike: warnings come from rank 0, and one rank's mistake ends all.

        Inside it there may be no exchange between ranks.

        Raises:
            UserError: On rank 0: what went wrong, on which rank.
            ReportedError: On the other ranks.
        """
        yield

    def from_first(self, function: Callable[[], Result]) -> Result:
        """What a function returns on rank 0, where alone it is called.

        Raises:
            UserError: The function did, on rank 0.
            ReportedError: On the other ranks then.
        """
        return function()

    def least(self, value: int) -> int:
        """The smallest of all ranks' values."""
        return value

    def require_same(self, facts: Mapping[str, str]) -> None:
        """Compares facts that have to be the same on all ranks.

        Raises:
            UserError: Some are not.
        """

    def share(self, tensors: Iterable[Tensor]) -> None:
        """Gives rank 0's values to all ranks, in place."""

    def average(self, parameters: Iterable[Tensor], losses: Losses) -> Losses:
        """Replaces gradients by their means over the ranks; returns the mean losses, detached.

        A parameter without a gradient on some ranks counts as zero there; without one on all, it keeps none.

        Raises:
            LostRankError: A rank is gone.
            DivergedRanksError: The ranks' models differ in size.
        """
        return losses

    def pool(self, statistics: ScreenStatistics) -> ScreenStatistics:
        """All ranks' screen statistics as one: sums and maxima.

        Raises:
            LostRankError: A rank is gone.
        """
        return statistics


def same_everywhere(
    method: Method, views: Sequence[View], config: object, precision: torch.dtype
) -> dict[str, str]:
    """What has to be the same on all ranks before they begin, for `Team.require_same`.

    Args:
        method: What is trained.
        views: The photos that train.
        config: Of the training.
        precision: Of the networks.
    """
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
