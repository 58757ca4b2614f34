"""CUDA graphs for networks whose inputs come in a few shapes: hundreds of small kernels, launched as one.

Parsing and the triplane's UNet take hundreds of kernels each way that run for microseconds; to launch them one by
one takes the host longer than the device takes for the whole picture. Forward and backward pass are captured for
every shape that comes up again, as `torch.cuda.make_graphed_callables` does, with three differences: parameters are
captured through aliases, so that no gradient accumulator of an eager step takes part; other threads may use CUDA
meanwhile; and gradients are written by one autograd function instead of one accumulator a parameter.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Hashable, Iterable, Sequence
from typing import Any, TypeVar

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from wildgs import features
from wildgs.errors import WildGSWarning

EAGER_CALLS = 2
"""Calls of one shape before it is recorded: a shape that comes once is not worth it."""
MOST_GRAPHS = 32
"""Further ones run without. Parsing has 13 shapes at most (`Parsing.shrink`), each of them with and without a mask
that learns; a ResNet encoder learns on the same steps as the mask does."""
WARM_UP = 3
"""Passes before the capture, in which libraries choose their kernels and allocate their workspaces."""
TOLERANCE = 0.05
"""Relative difference up to which a graph is accepted, in the Euclidean norm over all outputs, and over all
gradients: two runs in bfloat16, and kernels that libraries choose differently while recording. Single small tensors
may differ by more: gradients that are summed with atomics do from one eager run to the next."""

Outputs = tuple[Tensor, ...]
Network = Callable[..., Outputs]
Values = list[Tensor | None]
Result = TypeVar("Result")


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
        self._graphs: dict[Hashable, Recording] = {}
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

    def records(self, x: Tensor) -> bool:
        """Whether networks are recorded that take `x`."""
        return self.on and x.is_cuda and torch.is_grad_enabled()

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
        if not self.records(x):
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


class _Part(nn.Module):
    """What is recorded: a function of one tensor, and the modules whose parameters get gradients by it."""

    def __init__(self, network: Network, modules: Iterable[nn.Module], settings: Sequence[Any]) -> None:
        super().__init__()
        self.parts = nn.ModuleList(modules)
        self.network = network
        self.settings = settings

    def forward(self, x: Tensor) -> Outputs:
        return self.network(x, *self.settings)


class Recording:
    """The forward and the backward pass of a network at one shape, as two CUDA graphs.

    Attributes:
        learnt: Parameters that get gradients.
        gradients: Theirs, in the graphs' memory, in the parameters' memory layout; None for what takes no part.
    """

    def __init__(self, part: _Part, x: Tensor, memory: Any) -> None:
        """Records a network.

        Args:
            part: The network.
            x: Of the shape to record.
            memory: The pool from which both graphs take theirs.

        Raises:
            RuntimeError: It cannot be recorded.
        """
        named = {name: p for name, p in part.named_parameters() if p.requires_grad}
        self.learnt = list(named.values())
        # Leaves of their own that share the parameters' memory: the parameters' gradient accumulators may belong to
        # an eager step and to its stream, which would invalidate the capture.
        aliases = {name: parameter.detach().requires_grad_() for name, parameter in named.items()}
        self._x = x.clone()
        self._anchor = torch.zeros((), device=x.device, requires_grad=True)

        def forward() -> Outputs:
            return torch.func.functional_call(part, aliases, (self._x,))

        def backward() -> Values:
            learning = [output for output in outputs if output.requires_grad]
            found = torch.autograd.grad(learning, list(aliases.values()), self._incoming, allow_unused=True)
            return [
                None if gradient is None else _laid_out_as(alias, gradient)
                for alias, gradient in zip(aliases.values(), found, strict=True)
            ]

        torch.cuda.synchronize()
        with torch.cuda.stream(torch.cuda.Stream()):
            for _ in range(WARM_UP):
                outputs = forward()
                self._incoming = [torch.zeros_like(output) for output in outputs if output.requires_grad]
                backward()
        # Recording that fails may leave its stream the current one.
        with torch.cuda.stream(torch.cuda.current_stream()):
            self._forward, outputs = _captured(forward, memory)
            self._backward, self.gradients = _captured(backward, memory)
        self._outputs = [output.detach() for output in outputs]
        self._learning = [output.requires_grad for output in outputs]

    def __call__(self, x: Tensor) -> Outputs:
        """What the network gives for `x`."""
        if features.is_on("written_gradients"):
            return _Replay.apply(self, x, self._anchor)
        return _Replay.apply(self, x, *self.learnt)

    def replay_forward(self, x: Tensor) -> Outputs:
        """The outputs, in the graph's memory."""
        self._x.copy_(x)
        self._forward.replay()
        return tuple(output.detach() for output in self._outputs)

    def replay_backward(self, incoming: Sequence[Tensor]) -> None:
        """Computes `gradients`."""
        for parameter, gradient in zip(self.learnt, self.gradients, strict=True):
            if gradient is not None and parameter.grad is gradient:
                parameter.grad = gradient.clone()  # of a replay before, to which this one's will be added
        wanted = [gradient for gradient, learns in zip(incoming, self._learning, strict=True) if learns]
        for place, gradient in zip(self._incoming, wanted, strict=True):
            place.copy_(gradient)
        self._backward.replay()

    def write_gradients(self) -> None:
        """Gives every parameter its gradient, as its accumulator would."""
        for parameter, gradient in zip(self.learnt, self.gradients, strict=True):
            if gradient is not None:
                parameter.grad = gradient if parameter.grad is None else parameter.grad + gradient


class _Replay(torch.autograd.Function):
    """One replay each way. Its differentiable input is the parameters, or one number that stands for them."""

    @staticmethod
    def forward(ctx: Any, recording: Recording, x: Tensor, *inputs: Tensor) -> Outputs:
        ctx.recording = recording
        ctx.writes = len(inputs) == 1 and inputs[0] is recording._anchor
        outputs = recording.replay_forward(x)
        fixed = [output for output, learns in zip(outputs, recording._learning, strict=True) if not learns]
        ctx.mark_non_differentiable(*fixed)
        return outputs

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> Any:
        recording: Recording = ctx.recording
        recording.replay_backward(gradients)
        if ctx.writes:
            recording.write_gradients()
            return None, None, None
        # Copies: an accumulator would keep the graph's own memory, which the next replay overwrites.
        return (
            None,
            None,
            *(None if gradient is None else gradient.clone() for gradient in recording.gradients),
        )


def _captured(function: Callable[[], Result], memory: Any) -> tuple[Any, Result]:
    """A CUDA graph of what a function launches, and what it returned.

    Threads that decode photos or write checkpoints go on meanwhile; their calls must not invalidate the capture.
    """
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph, pool=memory, capture_error_mode="thread_local"):
        result = function()
    return graph, result


def _laid_out_as(parameter: Tensor, gradient: Tensor) -> Tensor:
    """A gradient in its parameter's memory layout, which fused Adam asks for."""
    strides = zip(parameter.shape, parameter.stride(), gradient.stride(), strict=True)
    if all(one == other for size, one, other in strides if size > 1):
        return gradient
    return torch.empty_like(parameter, requires_grad=False).copy_(gradient)


def _record(part: _Part, x: Tensor, memory: Any) -> Recording:
    """A recording of the part at this shape, compared with the part itself once.

    Raises:
        RuntimeError: It cannot be recorded, or gives other numbers.
    """
    recording = Recording(part, x, memory)
    wanted = _values_and_gradients(part, x, recording.learnt)
    found = _values_and_gradients(recording, x, recording.learnt)
    if not all(_alike(one, other) for one, other in zip(wanted, found, strict=True)):
        raise RuntimeError("a replay gives other numbers")
    return recording


def _values_and_gradients(
    part: Callable[[Tensor], Outputs], x: Tensor, learnt: Sequence[nn.Parameter]
) -> tuple[Values, Values]:
    """Copies of what comes out, and of the parameters' gradients by it; the parameters keep those that they had."""
    before = [parameter.grad for parameter in learnt]
    for parameter in learnt:
        parameter.grad = None
    outputs = part(x)
    torch.stack([output.float().square().mean() for output in outputs]).sum().backward()
    copies = [
        [None if value is None else value.detach().float().clone() for value in values]
        for values in (outputs, [parameter.grad for parameter in learnt])
    ]
    for parameter, gradient in zip(learnt, before, strict=True):
        parameter.grad = gradient
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
