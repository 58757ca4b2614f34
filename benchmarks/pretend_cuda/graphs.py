"""CUDA graphs on the pretended device: operations are noted while they are captured, and done again by a replay."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from .tensors import FREE, RECORD

_numbers = count(1)


class CUDAGraph:
    """Stands for `torch.cuda.CUDAGraph`: the same operations on the same tensors, whatever they hold by then."""

    def __init__(self) -> None:
        self.operations: list[tuple[Any, Any, Any, list[Tensor]]] = []

    def replay(self) -> None:
        """One launch."""
        with RECORD.silence(), torch.no_grad():
            for function, args, kwargs, made in self.operations:
                results = [
                    leaf for leaf in tree_leaves(function(*args, **kwargs)) if isinstance(leaf, Tensor)
                ]
                for place, value in zip(made, results, strict=True):
                    if place is not value:
                        place.copy_(value)
        RECORD.launch("graph")


class _Notes(TorchDispatchMode):
    def __init__(self, recorded: CUDAGraph) -> None:
        super().__init__()
        self.recorded = recorded

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = function(*args, **(kwargs or {}))
        if function._schema.name.partition("::")[2] not in FREE:
            made = [leaf for leaf in tree_leaves(result) if isinstance(leaf, Tensor)]
            self.recorded.operations.append((function, args, kwargs or {}, made))
        return result


@contextmanager
def graph(recorded: CUDAGraph, *, pool: Any, capture_error_mode: str) -> Iterator[None]:
    """Stands for `torch.cuda.graph`: while operations are captured, the host must not wait."""
    RECORD.capturing = True
    try:
        with RECORD.silence(), _Notes(recorded):
            yield
    finally:
        RECORD.capturing = False
    RECORD.graphs += 1


def graph_pool_handle() -> tuple[int, int]:
    """A number for memory that graphs share."""
    return 0, next(_numbers)
