"""CUDA graphs on the pretended device: what a replay overwrites is overwritten, and a replay is one launch."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import count
from typing import Any

import torch
from torch import Tensor

from pretend_cuda.tensors import RECORD


class _Graph(torch.autograd.Function):
    """A replay: one launch each way, besides those that carry tensors in and out of the graph's own memory."""

    @staticmethod
    def forward(ctx: Any, graph: _Recorded, x: Tensor, *parameters: Tensor) -> Any:
        with RECORD.silence(), torch.enable_grad():
            graph.x.copy_(x)
            outputs = graph.function(graph.x)
            if not graph.outputs:
                graph.outputs = [output.detach().clone() for output in outputs]
            for other in graph.sharing:
                for kept in other.outputs:
                    kept.fill_(torch.nan)  # as good as anything: its memory is another's now
            for kept, output in zip(graph.outputs, outputs, strict=True):
                kept.copy_(output.detach())
        ctx.outputs, ctx.parameters = outputs, parameters
        RECORD.launch("copy into a graph")
        RECORD.launch("graph")
        return tuple(output.detach() for output in graph.outputs)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Any:
        pairs = [(o, g) for o, g in zip(ctx.outputs, gradients, strict=True) if o.requires_grad]
        with RECORD.silence():
            found = torch.autograd.grad(
                [output for output, _ in pairs],
                ctx.parameters,
                [gradient for _, gradient in pairs],
                allow_unused=True,
            )
        for _ in pairs:
            RECORD.launch("copy into a graph")
        RECORD.launch("graph, backward")
        return (None, None, *found)


@dataclass
class _Recorded:
    function: Callable[[Tensor], tuple[Tensor, ...]]
    x: Tensor
    sharing: list[_Recorded]
    outputs: list[Tensor] = field(default_factory=list)


_pools: dict[Any, list[_Recorded]] = defaultdict(list)
_numbers = count(1)


def graph_pool_handle() -> tuple[int, int]:
    """A number for memory that graphs share."""
    return 0, next(_numbers)


def make_graphed_callables(
    part: Any, sample: tuple[Tensor], *, allow_unused_input: bool = False, pool: Any = None
) -> Any:
    """Like `torch.cuda.make_graphed_callables` for one input: what comes out is overwritten by the next replay.

    Of another graph with the same memory, too.
    """
    RECORD.graphs += 1
    sharing = _pools[pool]
    graph, parameters = _Recorded(part.forward, sample[0], sharing), tuple(part.parameters())
    sharing.append(graph)
    return lambda x: _Graph.apply(graph, x, *parameters)
