"""Tensors that say they are on CUDA, and the record of what is done with them."""

from __future__ import annotations

import traceback
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, field
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor
from torch.utils import _foreach_utils
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map

CUDA = torch.device("cuda", 0)
FREE = frozenset((
    "view", "_unsafe_view", "permute", "transpose", "t", "expand", "slice", "select", "unsqueeze",
    "squeeze", "detach", "alias", "as_strided", "unbind", "split", "split_with_sizes", "reshape",
    "_reshape_alias", "empty", "empty_like", "empty_strided", "new_empty", "new_empty_strided",
    "lift_fresh", "diagonal", "unfold", "resize_", "_local_scalar_dense",
))  # fmt: skip
"""Operations that launch nothing."""
COUNTING = frozenset((
    "nonzero", "masked_select", "repeat_interleave", "_unique2", "equal", "is_nonzero", "_linalg_check_errors",
))  # fmt: skip
"""Operations after which the host waits: for the size of the result, or for the result."""
CARRYING = frozenset(("_to_copy", "copy_", "_copy_from", "_foreach_copy_"))
"""Operations that take tensors of several devices."""


@dataclass
class Record:
    """What the device was told to do since `clear`.

    Attributes:
        launches: Operations that launch a kernel or more, by name.
        waits: What made the host wait for the device, by operation and line.
        bytes: Tensors that those operations read and wrote. What gsplat and networks in graphs do is not in it.
        graphs: CUDA graphs recorded, ever.
    """

    launches: Counter[str] = field(default_factory=Counter)
    waits: Counter[str] = field(default_factory=Counter)
    bytes: int = 0
    graphs: int = 0
    paused: bool = False
    capturing: bool = False

    def clear(self) -> None:
        """Starts again."""
        self.launches.clear()
        self.waits.clear()
        self.bytes = 0

    def launch(self, name: str, size: int = 0) -> None:
        """One more operation."""
        if not self.paused:
            self.launches[name] += 1
            self.bytes += size

    def wait(self, name: str) -> None:
        """The host waits.

        Raises:
            RuntimeError: A graph is being captured.
        """
        if self.capturing:
            raise RuntimeError(f"operation not permitted when stream is capturing: {name}, {_line()}")
        if not self.paused:
            self.waits[f"{name}, {_line()}"] += 1

    @contextmanager
    def silence(self) -> Iterator[None]:
        """What happens in here counts for nothing."""
        before, self.paused = self.paused, True
        try:
            yield
        finally:
            self.paused = before


RECORD = Record()


def _line() -> str:
    """The package's line that is being run."""
    for frame in reversed(traceback.extract_stack()):
        if "/wildgs/" in frame.filename:
            return f"{frame.filename.rpartition('/wildgs/')[2]}:{frame.lineno}"
    return "torch"


class Pretended(Tensor):
    """A tensor in main memory, `inner`, that says it is on CUDA."""

    inner: Tensor

    @staticmethod
    def __new__(cls, inner: Tensor) -> Pretended:
        """Wraps a tensor."""
        return Tensor._make_wrapper_subclass(
            cls, inner.size(), strides=inner.stride(), storage_offset=inner.storage_offset(),
            dtype=inner.dtype, device=CUDA,
        )  # fmt: skip

    def __init__(self, inner: Tensor) -> None:
        self.inner = inner

    def __repr__(self, **_: Any) -> str:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Its inner tensor's."""
        return f"Pretended({self.inner!r})"

    def tolist(self) -> Any:
        """Its numbers; torch would read them from memory that a wrapper has not."""
        return self.cpu().tolist()

    @classmethod
    def __torch_dispatch__(cls, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Runs an operation on the inner tensors."""
        return _run(function, args, kwargs or {})


class _Dispatch(TorchDispatchMode):
    """Sees operations that have no pretended operand: those that make or carry tensors."""

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(function, args, kwargs or {})


def _is_cuda(device: Any) -> bool:
    return device is not None and torch.device(device).type == "cuda"


def _run(function: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    """One operation: checks devices, counts, computes."""
    name = function._schema.name.partition("::")[2]
    leaves, _ = tree_flatten((args, kwargs))
    tensors = [leaf for leaf in leaves if isinstance(leaf, Tensor)]
    there = [tensor for tensor in tensors if isinstance(tensor, Pretended)]
    here = [tensor for tensor in tensors if not isinstance(tensor, Pretended) and tensor.dim() > 0]
    device = kwargs.get("device")
    downloads = bool(there) and device is not None and not _is_cuda(device)
    concerned = bool(there) or _is_cuda(device)
    if concerned:
        _note_waits(name, args, kwargs, here, downloads)
    pinned = kwargs.get("pin_memory")
    kwargs = {key: _inner(value) for key, value in kwargs.items() if key != "pin_memory"}
    result = function(*tree_map(_inner, args), **kwargs)
    if not concerned or downloads:
        if pinned:
            result.pinned = True
        return result
    # What an operation changed in place is the tensor that it was given.
    known = {id(_inner(tensor)): tensor for tensor in tensors}

    def wrapped(leaf: Any) -> Any:
        if not isinstance(leaf, Tensor) or isinstance(leaf, Pretended):
            return leaf
        return known[id(leaf)] if id(leaf) in known else Pretended(leaf)

    if name not in FREE:
        made = [leaf for leaf in tree_flatten(result)[0] if isinstance(leaf, Tensor)]
        RECORD.launch(name, sum(_size(tensor) for tensor in there) + sum(_size(tensor) for tensor in made))
    return tree_map(wrapped, result)


def _size(tensor: Tensor) -> int:
    return tensor.numel() * tensor.element_size()


def _inner(leaf: Any) -> Any:
    if isinstance(leaf, Pretended):
        return leaf.inner
    if isinstance(leaf, torch.device) and leaf.type == "cuda":
        return torch.device("cpu")
    return leaf


def _note_waits(name: str, args: Any, kwargs: dict[str, Any], here: list[Tensor], downloads: bool) -> None:
    if here and name not in CARRYING and not name.startswith("index"):
        shapes = ", ".join(str(tuple(tensor.shape)) for tensor in here)
        raise RuntimeError(f"{name}: tensors on cuda and on the CPU (shapes {shapes}), {_line()}")
    if name == "_local_scalar_dense":
        RECORD.wait("a number read")
    elif downloads:
        RECORD.wait("a tensor read")
    elif name in COUNTING or _has_boolean_index(name, args):
        RECORD.wait(name)
    elif here and not (_non_blocking(args, kwargs) and all(getattr(t, "pinned", False) for t in here)):
        RECORD.wait("a tensor written")


def _non_blocking(args: Any, kwargs: dict[str, Any]) -> bool:
    return bool(kwargs.get("non_blocking")) or (len(args) == 3 and args[2] is True)


def _has_boolean_index(name: str, args: Any) -> bool:
    if not name.lstrip("_").startswith("index") or len(args) < 2 or not isinstance(args[1], (list, tuple)):
        return False
    return any(isinstance(index, Tensor) and index.dtype in (torch.bool, torch.uint8) for index in args[1])


def _pin(tensor: Tensor) -> Tensor:
    pinned = tensor.clone()
    pinned.pinned = True  # pyright: ignore[reportAttributeAccessIssue]
    return pinned


_plain_tensor = torch.tensor


def _tensor(data: Any, *args: Any, device: Any = None, **kwargs: Any) -> Tensor:
    """`torch.tensor`, which writes to the device's memory by itself."""
    made = _plain_tensor(data, *args, **kwargs)
    return made.to(device) if _is_cuda(device) else made


class _Event:
    """Stands for `torch.cuda.Event`; what it marks is done already."""

    def record(self) -> None: ...

    def synchronize(self) -> None: ...


@contextmanager
def pretend() -> Iterator[Record]:
    """See `pretend_cuda.device`."""
    from wildgs import features
    from wildgs.rasterize import cuda as backend

    from . import graphs
    from .gsplat import StandIn

    gsplat = StandIn()
    torch.__future__.set_overwrite_module_params_on_conversion(True)
    with ExitStack() as stack:
        stack.enter_context(_Dispatch())
        for target, name, value in (
            (torch, "tensor", _tensor),
            (Tensor, "pin_memory", _pin),
            (Tensor, "is_cuda", property(lambda tensor: tensor.device.type == "cuda")),
            (_foreach_utils, "_foreach_supported_types", [Tensor, torch.nn.Parameter, Pretended]),
            (torch.cuda, "is_available", lambda: True),
            (torch.cuda, "_lazy_init", lambda: None),
            (torch.cuda, "is_bf16_supported", lambda **_: True),
            (torch.cuda, "synchronize", lambda *_: RECORD.wait("synchronize")),
            (torch.cuda, "get_device_capability", lambda *_: (9, 0)),
            (torch.cuda, "get_rng_state", lambda *_: torch.get_rng_state()),
            (torch.cuda, "set_rng_state", lambda *_: None),
            (torch.cuda, "mem_get_info", lambda *_: (70 << 30, 80 << 30)),
            (torch.cuda, "max_memory_allocated", lambda *_: 0),
            (torch.cuda, "empty_cache", lambda: None),
            (torch.cuda, "get_device_name", lambda *_: "no GPU, pretended"),
            (torch.cuda, "Event", _Event),
            (torch.cuda, "Stream", lambda *_: None),
            (torch.cuda, "current_stream", lambda *_: None),
            (torch.cuda, "stream", nullcontext),
            (torch.cuda, "CUDAGraph", graphs.CUDAGraph),
            (torch.cuda, "graph", graphs.graph),
            (torch.cuda, "graph_pool_handle", graphs.graph_pool_handle),
            (backend, "load_gsplat", lambda: gsplat),
            (features, "_runs_triton", lambda: False),
        ):
            stack.enter_context(patch.object(target, name, value))
        try:
            yield RECORD
        finally:
            torch.__future__.set_overwrite_module_params_on_conversion(False)
