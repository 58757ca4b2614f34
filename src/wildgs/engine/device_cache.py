"""Keeps what training uploads again and again in the memory of a GPU."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from wildgs.devices import upload
from wildgs.engine.memory import free_memory

SHARE = 0.05
"""Fraction of the GPU's free memory that may be used. 1,000 photos of 1,000 x 750 pixels take 2.2 GB."""


class DeviceCache:
    """Tensors by kind and photo, up to a bound; those that do not fit are uploaded again at every use.

    Photos are used in random order, each once before any is used again, so that replacing old tensors by new ones
    would gain nothing.
    """

    def __init__(self, device: torch.device, capacity: int | None = None) -> None:
        """Creates an empty cache.

        Args:
            device: Device of the tensors.
            capacity: Upper bound on their total size in bytes. Default: `SHARE` of a GPU's free memory, and 0 for
                the CPU, which needs no copies.
        """
        if capacity is None:
            capacity = int(SHARE * (free_memory(device) or 0)) if device.type == "cuda" else 0
        self._device, self._free = device, capacity
        self._kept: dict[tuple[str, str], Tensor | None] = {}

    def __contains__(self, key: tuple[str, str]) -> bool:
        """Whether a tensor is kept."""
        return key in self._kept

    def get(self, kind: str, name: str, read: Callable[[], Tensor | None]) -> Tensor | None:
        """A tensor on the device; None if there is none.

        Args:
            kind: What it is of the photo.
            name: Name of the photo.
            read: Reads it into the main memory.
        """
        if (kind, name) in self._kept:
            return self._kept[kind, name]
        value = read()
        found = None if value is None else upload(value, self._device)
        size = 0 if found is None else found.numel() * found.element_size()
        if 0 < self._free >= size:
            self._free -= size
            self._kept[kind, name] = found
        return found
