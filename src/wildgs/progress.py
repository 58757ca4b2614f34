"""How long work tells its caller how far it is."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, runtime_checkable


@runtime_checkable
class Progress(Protocol):
    """A callback that long work calls as it continues; whoever passes one decides how it is shown."""

    def __call__(self, stage: str, done: int, total: int, /) -> None:
        """Takes note of progress.

        Args:
            stage: What is being done, as in "reading photos".
            done: Pieces that are done.
            total: Pieces in all; 0 where they are not known.
        """


def silent(stage: str, done: int, total: int, /) -> None:
    """A `Progress` that shows nothing."""


def counter(progress: Progress | None, stage: str) -> Callable[[int, int], None]:
    """A callback `(done, total)` for the pieces of one stage."""
    show = progress or silent
    return lambda done, total: show(stage, done, total)
