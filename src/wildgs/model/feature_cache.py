"""Features of photos that a frozen encoder gave, kept within a byte limit."""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence

import torch
from torch import Tensor

Shapes = tuple[tuple[int, ...], ...]
Packed = tuple[Tensor, Shapes]


def pack(tensors: Sequence[Tensor]) -> Packed:
    """Tensors of one dtype, flattened and joined, with their shapes."""
    return torch.cat([tensor.flatten() for tensor in tensors]), tuple(tuple(t.shape) for t in tensors)


def unpack(joined: Tensor, shapes: Shapes) -> list[Tensor]:
    """The tensors that `pack` joined, as views."""
    parts = joined.split([math.prod(shape) for shape in shapes])
    return [part.view(shape) for part, shape in zip(parts, shapes, strict=True)]


class FeatureCache:
    """Keeps the features of the first photos that fit.

    Photos train in shuffled rounds, in which dropping what was used longest ago would drop nearly everything just
    before its turn.

    Attributes:
        limit: Bytes.
        num_bytes: Bytes of the features held now.
    """

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.num_bytes = 0
        self._kept: dict[Hashable, Packed] = {}

    def __len__(self) -> int:
        return len(self._kept)

    def get(self, key: Hashable) -> Packed | None:
        """Features, or None where they were not kept."""
        return self._kept.get(key)

    def put(self, key: Hashable, features: Packed) -> None:
        """Keeps features if there is room for them."""
        size = features[0].nbytes
        if key not in self._kept and self.num_bytes + size <= self.limit:
            self._kept[key] = features
            self.num_bytes += size
