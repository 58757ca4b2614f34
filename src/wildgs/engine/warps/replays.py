"""Functions of tensors without gradients as CUDA graphs, one for each function and shape of its inputs.

Displacing a photo and registering it launch a hundred small kernels, which takes the host longer than the device.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from wildgs.model.replays import WARM_UP, GraphStore, alike, captured

MOST_PIXELS = 8_000_000
"""Upper bound on the pixels of all graphs together, for each of which they keep up to a hundred bytes."""

Function = Callable[..., Tensor]


class FunctionReplays(GraphStore["FunctionRecording"]):
    """Calls a function, or replays a captured graph of it; only calls on CUDA are captured."""

    most_pixels = MOST_PIXELS

    def records(self, x: Tensor) -> bool:
        """Whether calls with the input `x` are captured."""
        return self.on and x.is_cuda

    @torch.no_grad()
    def __call__(self, function: Function, *inputs: Tensor) -> Tensor:
        """``function(*inputs)``.

        Args:
            function: It must launch the same kernels for the same shapes, must not synchronise, and must not use
                random numbers. Functions are told apart by their names.
            inputs: Its arguments, of one data type; the first one is an image [H, W, ...].
        """
        if not self.records(inputs[0]):
            return function(*inputs)
        key = (function.__name__, *(tuple(each.shape) for each in inputs))

        def capture(memory: Any) -> FunctionRecording:
            recording = FunctionRecording(function, inputs, memory)
            if not alike([function(*inputs)], [recording(inputs)]):
                raise RuntimeError("results of a replay differ from eager execution")
            return recording

        recording = self.find(key, capture, inputs[0].shape[:2].numel())
        return function(*inputs) if recording is None else recording(inputs)


class FunctionRecording:
    """A function for inputs of one shape, as a CUDA graph."""

    def __init__(self, function: Function, inputs: tuple[Tensor, ...], memory: Any) -> None:
        """Captures the function.

        Args:
            function: The function.
            inputs: Arguments of the shapes to capture.
            memory: Memory pool of the graph.

        Raises:
            RuntimeError: The function cannot be captured.
        """
        self._inputs = [each.detach().clone() for each in inputs]
        torch.cuda.synchronize()
        with torch.cuda.stream(torch.cuda.Stream()):
            for _ in range(WARM_UP):
                function(*self._inputs)
        # Restores the current stream if the capture fails.
        with torch.cuda.stream(torch.cuda.current_stream()):
            self._graph, self._output = captured(lambda: function(*self._inputs), memory)

    def __call__(self, inputs: tuple[Tensor, ...]) -> Tensor:
        """Replays the function; the result is a copy, because the next replay overwrites the graph's memory."""
        torch._foreach_copy_(self._inputs, list(inputs))  # pyright: ignore[reportPrivateImportUsage]
        self._graph.replay()
        return self._output.clone()
