"""Progress callbacks, and a thread pool that reports progress."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Protocol, TypeVar, runtime_checkable

Item = TypeVar("Item")
Result = TypeVar("Result")
Counter = Callable[[int, int], None]
"""Called with (items done, total number of items)."""


@runtime_checkable
class Progress(Protocol):
    """A callback for the progress of long work."""

    def __call__(self, stage: str, done: int, total: int, /) -> None:
        """Reports progress.

        Args:
            stage: What is being done, such as "reading photos".
            done: Items done.
            total: Total number of items; 0 if unknown.
        """


def silent(stage: str, done: int, total: int, /) -> None:
    """A `Progress` that shows nothing."""


def counter(progress: Progress | None, stage: str) -> Counter:
    """A callback for the items of one stage."""
    show = progress or silent
    return lambda done, total: show(stage, done, total)


def in_threads(
    function: Callable[[Item], Result], items: Sequence[Item], threads: int, progress: Counter | None = None
) -> Iterator[Result]:
    """Yields a function's result for each item, in order, computed by several threads that stop on an error."""
    pool = ThreadPoolExecutor(threads)
    try:
        for done, result in enumerate(pool.map(function, items), start=1):
            yield result
            if progress is not None:
                progress(done, len(items))
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
