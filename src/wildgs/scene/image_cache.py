"""Cache of decoded photos with a memory limit; other photos are decoded in background threads before their use.

Photos are trained in shuffled epochs, so that a least-recently-used cache would evict nearly every photo just
before its next use. Instead, the first photos that fit are kept permanently, and a small window holds the others
around their use, which gives the largest possible hit rate.
"""

from __future__ import annotations

import os
import threading
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from wildgs.processes import local_world_size
from wildgs.scene.config import DECODERS
from wildgs.scene.images import Photo

AHEAD = 4
"""Number of photos that are decoded in advance."""

_WINDOW = AHEAD + 2


class ImageCache:
    """A thread-safe cache of decoded photos.

    Attributes:
        limit: Memory limit in bytes; the last few photos are kept even if they exceed it.
        decoded: Number of cache misses so far.
    """

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.decoded = 0
        self._lock = threading.Lock()
        self._kept: dict[str, Photo] = {}
        self._recent: OrderedDict[str, Photo] = OrderedDict()
        self._pending: dict[str, Future[Photo]] = {}
        self._largest = 0
        self._kept_bytes = 0
        self._recent_bytes = 0
        self._pool: ThreadPoolExecutor | None = None

    @property
    def num_bytes(self) -> int:
        """Memory of all cached photos, bytes."""
        return self._kept_bytes + self._recent_bytes

    def put(self, name: str, photo: Photo, *, keep: bool = True) -> None:
        """Adds a decoded photo; with `keep`, as for training photos, it may be kept permanently."""
        size = photo.num_bytes
        with self._lock:
            if name in self._kept or name in self._recent:
                return
            self._largest = max(self._largest, size)
            if keep and self._kept_bytes + size + _WINDOW * self._largest <= self.limit:
                self._kept[name] = photo
                self._kept_bytes += size
            else:
                self._recent[name] = photo
                self._recent_bytes += size
            while self.num_bytes > self.limit and len(self._recent) > _WINDOW:
                _, old = self._recent.popitem(last=False)
                self._recent_bytes -= old.num_bytes

    def get(self, name: str, load: Callable[[], Photo]) -> Photo:
        """A photo from the cache or a background thread, else decoded now by `load`."""
        with self._lock:
            if name in self._kept:
                return self._kept[name]
            if name in self._recent:
                self._recent.move_to_end(name)
                return self._recent[name]
            pending = self._pending.get(name)
        return pending.result() if pending is not None else self._decode(name, load)

    def prefetch(self, name: str, load: Callable[[], Photo]) -> None:
        """Starts decoding in the background unless the photo is cached or being decoded."""
        with self._lock:
            if name in self._kept or name in self._recent or name in self._pending:
                return
            if self._pool is None:
                self._pool = ThreadPoolExecutor(DECODERS, thread_name_prefix="decode")
            self._pending[name] = self._pool.submit(self._decode, name, load)

    def _decode(self, name: str, load: Callable[[], Photo]) -> Photo:
        try:
            photo = load()
            self.put(name, photo, keep=False)
        finally:
            with self._lock:
                self.decoded += 1
                self._pending.pop(name, None)
        return photo


def available_memory() -> int | None:
    """Available memory of this process in bytes; None if unknown.

    The memory is divided equally among torchrun's processes on this machine.
    """
    found = []
    try:
        for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines():
            if line.startswith("MemAvailable:"):
                found.append(int(line.split()[1]) * 1024)
    except (OSError, ValueError):
        pass
    try:  # a container's limit (cgroup v2)
        group = Path("/sys/fs/cgroup")
        maximum = (group / "memory.max").read_text(encoding="ascii").strip()
        if maximum != "max":
            found.append(int(maximum) - int((group / "memory.current").read_text(encoding="ascii")))
    except (OSError, ValueError):
        pass
    if not found:
        try:
            found.append(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
        except (AttributeError, ValueError, OSError):
            return None
    return max(0, min(found)) // local_world_size()
