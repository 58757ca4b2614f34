"""CUDA graphs for networks whose inputs have few different shapes.

Parsing and the triplane's UNet launch hundreds of kernels of a few microseconds in each pass, and launching them
takes the host longer than the device needs for the whole image. Forward and backward pass are captured for every
recurring shape, as by `torch.cuda.make_graphed_callables`, with three differences: parameters are captured through
aliases, so that gradient accumulators of eager steps are not involved; other threads may use CUDA during the
capture; and gradients are written by one autograd function instead of one accumulator per parameter.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Hashable, Iterable, Sequence
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from wildgs import features
from wildgs.errors import WildGSWarning

EAGER_CALLS = 2
"""Number of eager calls of a shape before it is captured."""
MOST_GRAPHS = 32
"""Upper bound on the number of graphs; further shapes run eagerly. Parsing has at most 13 shapes
(`Parsing.shrink`), each with and without training of the mask; a ResNet encoder is trained on the same steps as the
mask."""
WARM_UP = 3
"""Passes before the capture, in which libraries choose kernels and allocate workspaces."""
TOLERANCE = 0.05
"""Largest relative difference between a graph and eager execution, in the Euclidean norm over all outputs and over
all gradients. Differences are due to bfloat16, to kernels that libraries choose differently during capture, and to
gradients summed by atomics, which also differ between eager runs."""

Outputs = tuple[Tensor, ...]
Network = Callable[..., Outputs]
Values = list[Tensor | None]
Result = TypeVar("Result")
Graph = TypeVar("Graph")


class GraphStore(Generic[Graph]):
    """Captured graphs by what they depend on. All of them share their memory.

    Attributes:
        on: Whether to capture graphs.
        most_pixels: Upper bound on the pixels of all graphs together; None for none.
    """

    most_pixels: int | None = None

    def __init__(self) -> None:
        self.on = False
        self.switch(False)

    def __deepcopy__(self, memo: dict[int, Any]) -> GraphStore[Graph]:
        """A copy without graphs, since a copied network has other parameters."""
        copy = type(self)()
        copy.on = self.on
        return copy

    @property
    def recorded(self) -> int:
        """Number of captured graphs."""
        return len(self._graphs)

    def switch(self, on: bool) -> None:
        """Turns capturing on or off and discards all graphs."""
        self.on = on
        self._calls: dict[Hashable, int] = {}
        self._graphs: dict[Hashable, Graph] = {}
        self._pixels = 0
        self._memory: Any = None

    def find(self, key: Hashable, capture: Callable[[Any], Graph], pixels: int = 0) -> Graph | None:
        """The graph of a key, or None if it is not captured (yet).

        Capturing is turned off, with a warning, when it fails.

        Args:
            key: What the graph depends on.
            capture: Captures it into a memory pool; a RuntimeError means that it cannot be captured.
            pixels: What it counts towards `most_pixels`.
        """
        if key in self._graphs:
            return self._graphs[key]
        self._calls[key] = self._calls.get(key, 0) + 1
        full = self.most_pixels is not None and self._pixels + pixels > self.most_pixels
        if self._calls[key] <= EAGER_CALLS or len(self._graphs) == MOST_GRAPHS or full:
            return None
        try:
            self._memory = self._memory or torch.cuda.graph_pool_handle()
            self._graphs[key] = capture(self._memory)
        except RuntimeError as error:
            self.switch(False)
            reason = (str(error).strip() or type(error).__name__).splitlines()[0]
            warnings.warn(
                f"CUDA graphs do not work here ({reason}); training continues without them, a little slower",
                WildGSWarning,
                stacklevel=3,
            )
            return None
        self._pixels += pixels
        return self._graphs[key]


class Replays(GraphStore["Recording"]):
    """Calls a network, or replays a captured graph of it; only calls on CUDA with gradients are captured.

    Results of a replay, including gradients, must be used before the next replay of any shape.
    """

    def records(self, x: Tensor) -> bool:
        """Whether calls with the input `x` are captured."""
        return self.on and x.is_cuda and torch.is_grad_enabled()

    def __call__(
        self, network: Network, modules: Sequence[nn.Module], x: Tensor, settings: tuple[Hashable, ...] = ()
    ) -> Outputs:
        """``network(x, *settings)``.

        Args:
            network: Function of one tensor that returns several. It must launch the same kernels for the same shape
                and settings, must not synchronise, and must not use random numbers.
            modules: The modules that it calls.
            x: Input.
            settings: Further arguments; each combination is captured separately.
        """
        graph = None
        if self.records(x):
            key = (tuple(x.shape), x.requires_grad, *settings)
            graph = self.find(key, lambda memory: _record(_Part(network, modules, settings), x, memory))
        return network(x, *settings) if graph is None else graph(x)


class _Part(nn.Module):
    """The function to capture, and the modules whose parameters get gradients by it."""

    def __init__(self, network: Network, modules: Iterable[nn.Module], settings: Sequence[Any]) -> None:
        super().__init__()
        self.parts = nn.ModuleList(modules)
        self.network = network
        self.settings = settings

    def forward(self, x: Tensor) -> Outputs:
        return self.network(x, *self.settings)


class Recording:
    """The forward and the backward pass of a network for one shape, as two CUDA graphs.

    Attributes:
        learnt: Parameters that get gradients.
        gradients: Their gradients, in the graphs' memory and the parameters' memory format; None for unused ones.
        by_input: Gradient of the input, in the graphs' memory; None for an input without gradient.
    """

    def __init__(self, part: _Part, x: Tensor, memory: Any) -> None:
        """Captures a network.

        Args:
            part: The network.
            x: Input of the shape to capture.
            memory: Memory pool of both graphs.

        Raises:
            RuntimeError: The network cannot be captured.
        """
        named = {name: p for name, p in part.named_parameters() if p.requires_grad}
        self.learnt = list(named.values())
        self._x, learns_input = x.detach().clone(), x.requires_grad
        self._anchor = torch.zeros((), device=x.device, requires_grad=True)
        aliases: dict[str, Tensor] = {}
        place: dict[str, Tensor] = {}

        def forward() -> Outputs:
            # Separate leaves that share the parameters' memory, because the parameters' gradient accumulators may
            # belong to an eager step and its stream, which would invalidate the capture. They are new in every
            # pass, because those of the warm-up belong to its stream.
            aliases.update({name: parameter.detach().requires_grad_() for name, parameter in named.items()})
            place.update({"x": self._x.detach().requires_grad_(learns_input)})
            return torch.func.functional_call(part, aliases, (place["x"],))

        def backward() -> Values:
            learning = [output for output in outputs if output.requires_grad]
            leaves = [*aliases.values(), *(place.values() if learns_input else ())]
            found = torch.autograd.grad(learning, leaves, self._incoming, allow_unused=True)
            return [
                None if gradient is None else _laid_out_as(leaf, gradient)
                for leaf, gradient in zip(leaves, found, strict=True)
            ]

        torch.cuda.synchronize()
        with torch.cuda.stream(torch.cuda.Stream()):
            for _ in range(WARM_UP):
                outputs = forward()
                self._incoming = [torch.zeros_like(output) for output in outputs if output.requires_grad]
                backward()
        # Restores the current stream if the capture fails.
        with torch.cuda.stream(torch.cuda.current_stream()):
            self._forward, outputs = captured(forward, memory)
            self._backward, self.gradients = captured(backward, memory)
        self.by_input = self.gradients.pop() if learns_input else None
        self._outputs = [output.detach() for output in outputs]
        self._learning = [output.requires_grad for output in outputs]

    def __call__(self, x: Tensor) -> Outputs:
        """Replays the network for `x`."""
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
                parameter.grad = gradient.clone()  # of the previous replay, to which this one's will be added
        wanted = [gradient for gradient, learns in zip(incoming, self._learning, strict=True) if learns]
        for place, gradient in zip(self._incoming, wanted, strict=True):
            place.copy_(gradient)
        self._backward.replay()

    def write_gradients(self) -> None:
        """Sets or adds to every parameter's gradient, as its accumulator would."""
        for parameter, gradient in zip(self.learnt, self.gradients, strict=True):
            if gradient is not None:
                parameter.grad = gradient if parameter.grad is None else parameter.grad + gradient


class _Replay(torch.autograd.Function):
    """One replay of each pass. Its differentiable inputs are the parameters, or one scalar in their place."""

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
        # Cloned, because an accumulator would store the graph's memory, which the next replay overwrites.
        by_input = None if recording.by_input is None else recording.by_input.clone()
        if ctx.writes:
            recording.write_gradients()
            return None, by_input, None
        return (
            None,
            by_input,
            *(None if gradient is None else gradient.clone() for gradient in recording.gradients),
        )


def captured(function: Callable[[], Result], memory: Any) -> tuple[Any, Result]:
    """Captures a function; returns the CUDA graph and the function's result.

    Calls by other threads, which decode photos or write checkpoints, do not invalidate the capture.
    """
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph, pool=memory, capture_error_mode="thread_local"):
        result = function()
    return graph, result


def _laid_out_as(parameter: Tensor, gradient: Tensor) -> Tensor:
    """Converts a gradient to its parameter's memory format, as fused Adam requires."""
    strides = zip(parameter.shape, parameter.stride(), gradient.stride(), strict=True)
    if all(one == other for size, one, other in strides if size > 1):
        return gradient
    return torch.empty_like(parameter, requires_grad=False).copy_(gradient)


def _record(part: _Part, x: Tensor, memory: Any) -> Recording:
    """Captures a part for a shape and compares it with eager execution.

    Raises:
        RuntimeError: The part cannot be captured, or its results differ.
    """
    recording = Recording(part, x, memory)
    wanted = _values_and_gradients(part, x, recording.learnt)
    found = _values_and_gradients(recording, x, recording.learnt)
    if not all(alike(one, other) for one, other in zip(wanted, found, strict=True)):
        raise RuntimeError("results of a replay differ from eager execution")
    return recording


def _values_and_gradients(
    part: Callable[[Tensor], Outputs], x: Tensor, learnt: Sequence[nn.Parameter]
) -> tuple[Values, Values]:
    """Copies of outputs and of gradients of input and parameters; restores the parameters' previous ones."""
    x = x.detach().requires_grad_(x.requires_grad)
    before = [parameter.grad for parameter in learnt]
    for parameter in learnt:
        parameter.grad = None
    outputs = part(x)
    torch.stack([output.float().square().mean() for output in outputs]).sum().backward()
    copies = [
        [None if value is None else value.detach().float().clone() for value in values]
        for values in (outputs, [x.grad, *(parameter.grad for parameter in learnt)])
    ]
    for parameter, gradient in zip(learnt, before, strict=True):
        parameter.grad = gradient
    return copies[0], copies[1]


def alike(wanted: Values, found: Values) -> bool:
    """Whether the same values are None and the others agree up to `TOLERANCE` in their joint norm."""
    if [value is None for value in wanted] != [value is None for value in found]:
        return False
    ones, others = ([value for value in values if value is not None] for values in (wanted, found))
    if not ones:
        return True
    differences = [one - other for one, other in zip(ones, others, strict=True)]
    count = sum(one.numel() for one in ones)
    limit = TOLERANCE * nn.utils.get_total_norm(ones) + 1e-6 * count**0.5
    return bool(nn.utils.get_total_norm(differences) <= limit)
