"""Progress of long work, and work by threads that reports it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Protocol, TypeVar, runtime_checkable

Item = TypeVar("Item")
Result = TypeVar("Result")
Counter = Callable[[int, int], None]
"""Called with (pieces done, pieces in all)."""


@runtime_checkable
class Progress(Protocol):
    """A callback for the progress of long work."""

    def __call__(self, stage: str, done: int, total: int, /) -> None:
        """Called with what is being done, as in "reading photos", the pieces done, and in all (0 if not known)."""


def silent(stage: str, done: int, total: int, /) -> None:
    """A `Progress` that shows nothing."""


def counter(progress: Progress | None, stage: str) -> Counter:
    """A callback for the pieces of one stage."""
    show = progress or silent
    return lambda done, total: show(stage, done, total)


def in_threads(
    function: Callable[[Item], Result], items: Sequence[Item], threads: int, progress: Counter | None = None
) -> Iterator[Result]:
    """A function's result for each item, in order, computed by several threads, which stop on an error."""
    pool = ThreadPoolExecutor(threads)
    try:
        for done, result in enumerate(pool.map(function, items), start=1):
            yield result
            if progress is not None:
                progress(done, len(items))
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
