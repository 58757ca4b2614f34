"""Runs a compiled kernel on several threads that take work items from one shared counter.

A kernel releases the GIL and is called once per thread as `kernel(counter, *arguments)`; it takes work items with
`fetch_add(counter, 1)` until none are left. The result of an item must not depend on the thread that computes it,
so that results are the same for any number of threads. Numba's global thread pool is not used, so that several
Python threads (autograd's backward thread, a viewer) may launch kernels at the same time.
"""

from __future__ import annotations

import os
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from typing import Any, TypeVar

import numpy as np
import torch
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic
from torch import Tensor

from wildgs.errors import UserError
from wildgs.processes import freed_memory_kept

Item = TypeVar("Item")
Result = TypeVar("Result")

MOST_AT_ONCE = 8
"""Upper bound on the number of items that `infer_each` works on at once, since each has arrays of its own."""

_ANNOUNCE_AFTER = 1.0
_announced = threading.Event()

_limit: list[int] = []
"""Thread counts of the active `limited` blocks, the innermost last."""


@contextmanager
def limited(count: int | None) -> Iterator[None]:
    """Sets the number of threads of kernels and torch for the duration of the block; None changes nothing."""
    if count is None:
        yield
        return
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        with kernels_limited(count):
            yield
    finally:
        torch.set_num_threads(before)


@contextmanager
def kernels_limited(count: int) -> Iterator[None]:
    """Sets the number of threads of kernels, but not of torch, for the duration of the block."""
    _limit.append(count)
    try:
        yield
    finally:
        _limit.remove(count)


def thread_count() -> int:
    """Number of threads of kernels: that of `limited`, else `WILDGS_NUM_THREADS`, else torch's.

    Raises:
        UserError: `WILDGS_NUM_THREADS` is not a positive whole number.
    """
    if _limit:
        return _limit[-1]
    value = os.environ.get("WILDGS_NUM_THREADS")
    if value is None:
        return torch.get_num_threads()
    if not value.isdecimal() or int(value) == 0:
        raise UserError(
            f"WILDGS_NUM_THREADS={value!r} is not a positive integer; set it to a number of threads"
        )
    return int(value)


@cache
def _pool(process: int, workers: int) -> ThreadPoolExecutor:
    """The pool of worker threads; one per process, since threads do not survive a fork."""
    return ThreadPoolExecutor(workers, thread_name_prefix="wildgs")


def launch(kernel: Callable[..., None], *arguments: Any, items: int | None = None) -> None:
    """Runs a kernel on all threads and waits for it.

    Args:
        kernel: A compiled function `kernel(counter, *arguments)`.
        arguments: The kernel's arguments.
        items: Number of work items, if known: an upper bound on the number of threads.
    """
    workers = thread_count() if items is None else max(1, min(thread_count(), items))
    counter = np.zeros(1, np.int64)
    if not getattr(kernel, "overloads", True):
        announce_compilation(kernel, counter, *arguments)
        return
    if workers == 1:
        kernel(counter, *arguments)
        return
    helpers = _pool(os.getpid(), workers - 1)
    pending = [helpers.submit(kernel, counter, *arguments) for _ in range(workers - 1)]
    kernel(counter, *arguments)
    for job in pending:
        if not job.cancel():  # a job that has not started yet has no work left
            job.result()


def run_once(kernel: Callable[..., Any], *arguments: Any) -> Any:
    """Calls a short kernel on the calling thread only."""
    if getattr(kernel, "overloads", True):
        return kernel(*arguments)
    return announce_compilation(kernel, *arguments)


def begin(kernel: Callable[..., Any], *arguments: Any) -> Callable[[], Any]:
    """Starts a kernel in the background and returns a function that waits for its result."""
    workers = thread_count()
    if workers == 1 or not getattr(kernel, "overloads", True):
        result = run_once(kernel, *arguments)
        return lambda: result
    return _pool(os.getpid(), workers - 1).submit(kernel, *arguments).result


def infer_each(
    function: Callable[[Item], Result], items: Iterable[Item], device: torch.device
) -> Iterator[Result]:
    """Yields a function's result for each item, in order, computed without gradients.

    On a CPU, each thread computes a different item, and torch and kernels use one thread per item until the last
    result is taken. For photos of ordinary size that is faster than all threads on one item: torch's threads wait
    for each other after every operation, which takes several times as long while other programs use the cores.
    Results do not depend on the number of threads.

    Args:
        function: Called with one item; it must not depend on other calls.
        items: The items.
        device: The device on which the function computes.
    """

    def infer(item: Item) -> Result:
        with torch.no_grad():  # gradients are switched off for each thread
            return function(item)

    if device.type != "cpu":
        yield from map(infer, items)
        return
    workers = min(thread_count(), MOST_AT_ONCE)
    pool = ThreadPoolExecutor(workers, thread_name_prefix="wildgs-infer")
    pending: deque[Future[Result]] = deque()
    with limited(1), freed_memory_kept():
        try:
            for item in items:
                pending.append(pool.submit(infer, item))
                if len(pending) > workers:  # no more, since results may be large
                    yield pending.popleft().result()
            while pending:
                yield pending.popleft().result()
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def flat(tensor: Tensor) -> np.ndarray:
    """A tensor's values as a contiguous 1D array without gradient, as kernels take them."""
    return tensor.detach().contiguous().numpy().reshape(-1)


def announce_compilation(kernel: Callable[..., Any], *arguments: Any) -> Any:
    """Calls a kernel that may have to be compiled, and prints a line to stderr if that takes long."""
    timer = threading.Timer(_ANNOUNCE_AFTER, _announce)
    timer.daemon = True
    timer.start()
    try:
        return kernel(*arguments)
    finally:
        timer.cancel()


def _announce() -> None:
    if not _announced.is_set():
        _announced.set()
        print(
            "wildgs: compiling CPU kernels (kept on disk for later runs)",
            file=sys.stderr,
            flush=True,
        )


@intrinsic
def fetch_add(typingctx: Any, array: Any, amount: Any) -> Any:
    """Atomically adds to element 0 of an int64 array and returns the previous value."""

    def codegen(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> Any:
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        amount = context.cast(builder, args[1], sig.args[1], types.int64)
        return builder.atomic_rmw("add", data, amount, "monotonic")

    return types.int64(array, amount), codegen
