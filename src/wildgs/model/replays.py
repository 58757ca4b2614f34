"""CUDA graphs for networks whose inputs come in a few shapes: hundreds of small kernels, launched as one.

Parsing and the triplane's UNet take hundreds of kernels each way that run for microseconds; to launch them one by
one takes the host longer than the device takes for the whole picture. A graph is recorded for every shape that
comes up again, by torch's own `torch.cuda.make_graphed_callables`.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, cast

import torch
from torch import Tensor, nn

from wildgs.errors import WildGSWarning

EAGER_CALLS = 2
"""Calls of one shape before it is recorded: a shape that comes once is not worth it."""
MOST_GRAPHS = 28
"""Further shapes run without. Parsing has 13 shapes at most, each with or without gradients to the encoder."""
TOLERANCE = 0.05
"""Relative difference up to which a graph is accepted, in the Euclidean norm over all outputs, and over all
gradients: two runs in bfloat16, and kernels that libraries choose differently while recording. Single small tensors
may differ by more: gradients that are summed with atomics do from one eager run to the next."""

Outputs = tuple[Tensor, ...]
Network = Callable[..., Outputs]


class _Part(nn.Module):
    """What is recorded: a function of one tensor, and the modules whose parameters get gradients by it."""

    def __init__(self, network: Network, modules: Iterable[nn.Module], settings: Sequence[Any]) -> None:
        super().__init__()
        self.parts = nn.ModuleList(modules)
        self.network = network
        self.settings = settings

    def forward(self, x: Tensor) -> Outputs:
        return self.network(x, *self.settings)


class Replays:
    """Calls a network, or replays what was recorded of it.

    All of one network's graphs share their memory. What a replay gives, gradients included, is to be used up before
    the next one, of whatever shape.

    Attributes:
        on: Whether to record at all. Only calls on CUDA that record gradients ever are.
    """

    def __init__(self) -> None:
        self.on = False
        self._calls: dict[Hashable, int] = {}
        self._graphs: dict[Hashable, Callable[[Tensor], Outputs]] = {}
        self._memory: Any = None

    def __deepcopy__(self, memo: dict[int, Any]) -> Replays:
        """A copy of a network has parameters of its own, of which nothing is recorded yet."""
        copy = Replays()
        copy.on = self.on
        return copy

    @property
    def recorded(self) -> int:
        """How many graphs there are."""
        return len(self._graphs)

    def switch(self, on: bool) -> None:
        """Turns recording on or off, and forgets what was recorded."""
        self.on = on
        self._calls.clear()
        self._graphs.clear()
        self._memory = None

    def __call__(
        self, network: Network, modules: Sequence[nn.Module], x: Tensor, settings: tuple[Hashable, ...] = ()
    ) -> Outputs:
        """``network(x, *settings)``.

        Args:
            network: From one tensor to several. Launches the same kernels whenever shape and settings are the same,
                waits for nothing, draws nothing at random.
            modules: Those that it calls.
            x: Takes no gradient.
            settings: Further arguments; each combination is recorded by itself.
        """
        if not (self.on and x.is_cuda and torch.is_grad_enabled()):
            return network(x, *settings)
        key = (tuple(x.shape), *settings)
        if key in self._graphs:
            return self._graphs[key](x)
        self._calls[key] = self._calls.get(key, 0) + 1
        if self._calls[key] <= EAGER_CALLS or len(self._graphs) == MOST_GRAPHS:
            return network(x, *settings)
        try:
            self._memory = self._memory or torch.cuda.graph_pool_handle()
            self._graphs[key] = _record(_Part(network, modules, settings), x.detach(), self._memory)
        except RuntimeError as error:
            self.switch(False)
            reason = (str(error).strip() or type(error).__name__).splitlines()[0]
            warnings.warn(
                f"CUDA graphs cannot be used here ({reason}); training continues without, a little slower",
                WildGSWarning,
                stacklevel=2,
            )
            return network(x, *settings)
        return self._graphs[key](x)


def _record(part: _Part, x: Tensor, memory: Any) -> Callable[[Tensor], Outputs]:
    """A graph of the part at this shape, compared with the part itself once.

    Raises:
        RuntimeError: It cannot be recorded, or gives other numbers.
    """
    learnt = [parameter for parameter in part.parameters() if parameter.requires_grad]
    wanted = _values_and_gradients(part, x, learnt)
    # The graph keeps its example as the place from which it reads.
    with _stale_streams_overridden():
        recorded = torch.cuda.make_graphed_callables(part, (x.clone(),), allow_unused_input=True, pool=memory)
    graph = cast(Callable[[Tensor], Outputs], recorded)
    found = _values_and_gradients(graph, x, learnt)
    if not all(_alike(one, other) for one, other in zip(wanted, found, strict=True)):
        raise RuntimeError("a replay gives other numbers")
    return graph


@contextmanager
def _stale_streams_overridden() -> Iterator[None]:
    """Has autograd record gradient accumulators that an eager step made on the default stream, where torch can.

    Without it, one such accumulator that is still alive invalidates the capture.
    """
    override: Any = getattr(torch.autograd.graph, "set_override_stale_capture_stream", lambda enabled: None)
    override(True)
    try:
        yield
    finally:
        override(False)


Values = list[Tensor | None]


def _values_and_gradients(
    part: Callable[[Tensor], Outputs], x: Tensor, learnt: Sequence[nn.Parameter]
) -> tuple[Values, Values]:
    outputs = part(x)
    objective = torch.stack([output.float().square().mean() for output in outputs]).sum()
    gradients = torch.autograd.grad(objective, learnt, allow_unused=True)
    copies = [
        [None if value is None else value.detach().float().clone() for value in values]
        for values in (outputs, gradients)
    ]
    return copies[0], copies[1]


def _alike(wanted: Values, found: Values) -> bool:
    """Whether the same values are None, and the others differ little in their joint norm."""
    if [value is None for value in wanted] != [value is None for value in found]:
        return False
    ones, others = ([value for value in values if value is not None] for values in (wanted, found))
    if not ones:
        return True
    differences = [one - other for one, other in zip(ones, others, strict=True)]
    count = sum(one.numel() for one in ones)
    limit = TOLERANCE * nn.utils.get_total_norm(ones) + 1e-6 * count**0.5
    return bool(nn.utils.get_total_norm(differences) <= limit)
