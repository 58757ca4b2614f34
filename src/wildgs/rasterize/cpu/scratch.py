"""Large working memory that is used again by the next call instead of going back to the system."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

_lock = threading.Lock()
_free: dict[str, np.ndarray] = {}


@contextmanager
def scratch(name: str, size: int, dtype: type) -> Iterator[np.ndarray]:
    """A flat array with unknown content, kept under `name` afterwards.

    Threads that ask at the same time get arrays of their own; the largest is the one kept.
    """
    with _lock:
        array = _free.pop(name, None)
    if array is None or array.size < size:
        array = _aligned(size + size // 4, dtype)
    try:
        yield array[:size]
    finally:
        with _lock:
            kept = _free.get(name)
            if kept is None or kept.size < array.size:
                _free[name] = array


def _aligned(size: int, dtype: type) -> np.ndarray:
    """A flat array that starts at a cache line."""
    item = np.dtype(dtype).itemsize
    raw = np.empty(size + 64 // item, dtype)
    skip = -raw.ctypes.data % 64 // item
    return raw[skip : skip + size]
