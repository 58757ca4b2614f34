"""Decoded photos within a byte limit, the rest decoded again in background threads before they are needed.

Photos train in shuffled rounds, so a photo's next turn is about a round away: a cache that throws out what was
used longest ago would throw out nearly everything just before its turn. Here the first photos that fit stay for
good, and a small window holds the others around their turn: hits are as many as the limit allows.
"""

from __future__ import annotations

import os
import threading
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from wildgs.processes import local_world_size
from wildgs.scene.images import Photo

DECODERS = 4
"""Threads that decode photos; Pillow works without Python's lock."""

AHEAD = 4
"""Photos that are decoded before their turn."""

_WINDOW = AHEAD + 2


class ImageCache:
    """Keeps decoded photos; safe to use from several threads.

    Attributes:
        limit: Bytes; the last few photos are kept even if they exceed it.
        decoded: How many photos were decoded again so far.
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
        """Bytes of all photos held now."""
        return self._kept_bytes + self._recent_bytes

    def put(self, name: str, photo: Photo, *, keep: bool = True) -> None:
        """Adds a decoded photo; with `keep` it may stay, as photos that train do."""
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
        """A photo from the cache or from the background thread that decodes it, or else decoded now by `load`."""
        with self._lock:
            if name in self._kept:
                return self._kept[name]
            if name in self._recent:
                self._recent.move_to_end(name)
                return self._recent[name]
            pending = self._pending.get(name)
        return pending.result() if pending is not None else self._decode(name, load)

    def prefetch(self, name: str, load: Callable[[], Photo]) -> None:
        """Starts decoding in the background, unless the photo is here or on its way."""
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
    """Bytes that a process can still take without swapping; None where the system does not say.

    Processes that torchrun started on this machine get equal shares.
    """
    found = []
    try:
        for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines():
            if line.startswith("MemAvailable:"):
                found.append(int(line.split()[1]) * 1024)
    except (OSError, ValueError):
        pass
    try:  # a container's own limit (cgroup v2)
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
