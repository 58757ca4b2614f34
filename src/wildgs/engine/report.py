"""What observers of training are told after every step."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from wildgs.engine.density import DensityReport
from wildgs.engine.schedule import falls_on
from wildgs.losses.objective import Losses
from wildgs.rasterize import Rendering
from wildgs.scene import View


@dataclass(frozen=True)
class StepReport:
    """The result of a step, for observers.

    All tensors are detached from the autograd graph. A graph that outlives the step would keep its tile lists in
    memory, and its gradient accumulators, which are bound to the default stream, would invalidate the capture of a
    CUDA graph.

    Attributes:
        step: Number of steps done, from 1.
        view: The photo of the step.
        losses: All loss terms, as tensors, so that only reading them synchronises with the device.
        rendering: The render of the photo.
        visibility: The mask M; None for a method without one.
        num_gaussians: Number of Gaussians after the step.
        density: Result of densification, if it ran.
        skipped: Why the step (on a GPU: the previous step) was skipped for a non-finite loss or gradient, if it
            was.
        taken: Number of steps that this one counts as: photos of all processes.
        seconds: Training time so far, without that of observers.
    """

    step: int
    view: View
    losses: Losses
    rendering: Rendering
    visibility: Float[Tensor, "H W"] | None
    num_gaussians: int
    density: DensityReport | None
    seconds: float
    skipped: str | None = None
    taken: int = 1

    def falls_on(self, every: int) -> bool:
        """Whether this step reaches or passes a multiple of `every`."""
        return falls_on(self.step, self.taken, every)


Observer = Callable[[StepReport], None]
