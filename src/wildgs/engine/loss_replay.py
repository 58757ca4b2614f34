"""The loss and its gradient as one CUDA graph for each shape of photo.

The loss launches some two hundred small kernels forward and backward, and launching them takes the host longer than
computing them takes the device. Its gradient does not depend on what follows, so that one graph computes both.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from wildgs.losses.config import ObjectiveConfig
from wildgs.losses.evidence import proven_static
from wildgs.losses.objective import Losses, total_loss, weighted_losses
from wildgs.model.replays import WARM_UP, GraphStore, alike, captured

SCALARS = ("mask_weight", "sky_depth")
"""Inputs that are numbers outside of a graph."""
MOST_PIXELS = 8_000_000
"""Upper bound on the pixels of all graphs together, for each of which they keep about 60 bytes. The loss of a large
photo keeps a GPU busy anyway."""


class LossReplays(GraphStore["LossRecording"]):
    """`total_loss`, or a replay of a captured graph of it; only losses on CUDA are captured."""

    most_pixels = MOST_PIXELS

    def __call__(
        self, config: ObjectiveConfig, progress: float, photo: Tensor, render: Tensor, **options: Any
    ) -> Losses:
        """`total_loss` of the same arguments."""
        if not (self.on and is_on_cuda(render) and render.requires_grad):
            return total_loss(config, progress, photo, render, **options)
        inputs = _as_tensors(config, progress, photo, render, options)
        threshold = options.get("mask_threshold", 0.5)
        key = tuple(
            (name, tuple(value.shape), value.dtype, value.requires_grad)
            for name, value in inputs.items()
            if name not in SCALARS
        )

        def capture(memory: Any) -> LossRecording:
            recording = LossRecording(config, threshold, inputs, memory)
            recording.compare(inputs)
            return recording

        recording = self.find(key, capture, render.shape[:2].numel())
        if recording is None:
            return weighted_losses(config, **inputs, mask_threshold=threshold)
        return recording(inputs)


class LossRecording:
    """The loss and its gradients for inputs of one shape, as a CUDA graph."""

    def __init__(
        self, config: ObjectiveConfig, threshold: float, inputs: Mapping[str, Any], memory: Any
    ) -> None:
        """Captures the loss.

        Args:
            config: Weights.
            threshold: Threshold Th of static pixels.
            inputs: Arguments of `weighted_losses` of the shapes to capture.
            memory: Memory pool of the graph.

        Raises:
            RuntimeError: The loss cannot be captured.
        """
        self._config, self._threshold = config, threshold
        device = inputs["render"].device
        self._inputs = {
            name: torch.full((), value, device=device) if name in SCALARS else value.detach().clone()
            for name, value in inputs.items()
        }
        tensors = [name for name in inputs if name not in SCALARS]
        self._same_dtype = [
            [name for name in tensors if inputs[name].dtype == dtype]
            for dtype in {inputs[name].dtype for name in tensors}
        ]
        self._learnt = [name for name in tensors if inputs[name].requires_grad]

        torch.cuda.synchronize()
        with torch.cuda.stream(torch.cuda.Stream()):
            for _ in range(WARM_UP):
                self._computed(self._inputs)
        # Restores the current stream if the capture fails.
        with torch.cuda.stream(torch.cuda.current_stream()):
            self._graph, (self._terms, self._gradients) = captured(
                lambda: self._computed(self._inputs), memory
            )

    def __call__(self, inputs: Mapping[str, Any]) -> Losses:
        """Replays the loss for other inputs of the same shapes."""
        self._replay(inputs)
        total = _Replayed.apply(self._terms, self._gradients, *(inputs[name] for name in self._learnt))
        terms = dict(zip(Losses.NAMES, self._terms.clone(), strict=True))
        return Losses(**{**terms, "total": total})

    def _computed(self, inputs: Mapping[str, Any]) -> tuple[Tensor, list[Tensor]]:
        """The terms, and the gradients of what gets one."""
        leaves = {name: inputs[name].detach().requires_grad_() for name in self._learnt}
        losses = weighted_losses(self._config, **{**inputs, **leaves}, mask_threshold=self._threshold)
        gradients = torch.autograd.grad(losses.total, list(leaves.values()), materialize_grads=True)
        return torch.stack(list(losses.terms().values())), list(gradients)

    def compare(self, inputs: Mapping[str, Any]) -> None:
        """Compares a replay with eager execution.

        Raises:
            RuntimeError: They differ.
        """
        terms, gradients = self._computed(inputs)
        self._replay(inputs)
        pairs = zip((terms, *gradients), (self._terms, *self._gradients), strict=True)
        if not all(alike([wanted], [found]) for wanted, found in pairs):
            raise RuntimeError("results of a replay differ from eager execution")

    def _replay(self, inputs: Mapping[str, Any]) -> None:
        for name in SCALARS:
            self._inputs[name].fill_(inputs[name])
        for names in self._same_dtype:  # one launch for each list
            places = [self._inputs[name] for name in names]
            torch._foreach_copy_(places, [inputs[name].detach() for name in names])  # pyright: ignore[reportPrivateImportUsage]
        self._graph.replay()


class _Replayed(torch.autograd.Function):
    """The replayed loss as a function of what gets a gradient."""

    @staticmethod
    def forward(ctx: Any, terms: Tensor, gradients: list[Tensor], *learnt: Tensor) -> Tensor:
        ctx.gradients = gradients
        return terms[-1].clone()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *incoming: Tensor) -> Any:
        # New tensors, because the next replay overwrites those of the graph.
        return None, None, *torch._foreach_mul(ctx.gradients, incoming[0])  # pyright: ignore[reportPrivateImportUsage]


def is_on_cuda(tensor: Tensor) -> bool:
    """Whether a tensor can take part in a graph."""
    return tensor.is_cuda


def _as_tensors(
    config: ObjectiveConfig, progress: float, photo: Tensor, render: Tensor, options: Mapping[str, Any]
) -> dict[str, Any]:
    """Arguments of `weighted_losses` from those of `total_loss`, without those that are None."""
    inputs = {
        name: value
        for name, value in options.items()
        if name not in ("observations", "train_mask", "num_photos", "mask_threshold")
    }
    inputs |= {"photo": photo, "render": render}
    inputs["mask_weight"] = config.mask_weight(progress, options.get("num_photos"))
    inputs["sky_depth"] = float(options.get("sky_depth", 0.0))
    visibility, observations = inputs.get("visibility"), options.get("observations")
    if visibility is not None and not options.get("train_mask", True):
        inputs["visibility"] = visibility.detach()
    if "alpha" in inputs and not config.opaque_weight:
        inputs["alpha"] = inputs["alpha"].detach()  # selects pixels only
    if all(inputs.get(name) is None for name in ("disparity", "metric_depth", "sky")):
        inputs["depth"] = None  # otherwise its gradient would be zero instead of none
    if observations is not None:
        inputs["proven"] = proven_static(observations, *photo.shape[:2])
    return {name: value for name, value in inputs.items() if value is not None}
