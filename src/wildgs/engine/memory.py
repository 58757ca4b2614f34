"""How much memory a training will take, before it takes it.

Methods declare what they use (`wildgs.model.method.MemoryUse`); `benchmarks/memory.py` measures it as the peak
resident memory of short trainings that differ in one size. Decoded photos have a limit of their own.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from wildgs.errors import UserError
from wildgs.model.config import MemoryUse
from wildgs.model.registry import MethodName, method_type
from wildgs.scene import Scene
from wildgs.scene.image_cache import available_memory

MARGIN = 0.9
"""Share of the free memory that may be planned with."""


@dataclass(frozen=True)
class MemoryEstimate:
    """What training takes beside the decoded photos, bytes.

    Attributes:
        use: What the method declares.
        num_gaussians: Upper bound on their number.
        pixels: Of the largest photo, at the size at which it trains.
    """

    use: MemoryUse
    num_gaussians: int
    pixels: int

    @property
    def gaussians(self) -> int:
        """What the Gaussians take of it."""
        return self.num_gaussians * self.use.per_gaussian

    @property
    def total(self) -> int:
        """In all."""
        return self.use.fixed + self.pixels * self.use.per_pixel + self.gaussians

    def largest_budget(self, available: int) -> int:
        """The most Gaussians for which `available` bytes suffice; below 0 where nothing does."""
        rest = int(MARGIN * available) - (self.total - self.gaussians)
        return rest // self.use.per_gaussian


def free_memory(device: torch.device) -> int | None:
    """Free bytes where training will run; None where the system does not say."""
    if device.type == "cuda":
        return torch.cuda.mem_get_info(device)[0]
    return available_memory()


def plan_budget(
    method: MethodName, scene: Scene, budget: int, device: torch.device, *, explicit: bool
) -> tuple[int, str | None]:
    """A budget of Gaussians that fits, decided before training starts.

    Args:
        method: What will be trained.
        scene: Its photos are read already.
        budget: Upper bound on the number of Gaussians, as configured.
        device: Where training will run.
        explicit: Whether the user gave this budget: then it is never lowered.

    Returns:
        The budget, and a message for the user where it was lowered.

    Raises:
        UserError: The scene, or the budget that was asked for, cannot fit.
    """
    pixels = max(view.camera.width * view.camera.height for view in scene.views)
    estimate = MemoryEstimate(method_type(method).memory, budget, pixels)
    available = free_memory(device)
    if available is None or estimate.total <= MARGIN * available:
        return budget, None
    fits = estimate.largest_budget(available)
    size = f"{pixels / 1e6:.1f} megapixels"
    needs = f"{budget:,} Gaussians on photos of {size} take about {gigabytes(estimate.total)}"
    least = min(budget, len(scene.points))
    if fits < least:
        raise UserError(
            f"{needs}, and {gigabytes(available)} are free, too little for the {least:,} Gaussians of the start: "
            f"raise --downscale, lower --image-cache, or lower --max-gaussians to {max(fits, 0):,}"
            if fits > 0
            else f"photos of {pixels / 1e6:.1f} megapixels do not fit into the {gigabytes(available)} that are "
            "free: raise --downscale or lower --image-cache"
        )
    if explicit:
        raise UserError(
            f"{needs}, and {gigabytes(available)} are free: lower --max-gaussians to {fits:,}, raise --downscale, "
            "or leave --max-gaussians out"
        )
    return fits, f"{needs}, and {gigabytes(available)} are free: the budget is {fits:,} Gaussians"


def gigabytes(count: int) -> str:
    """Bytes as people read them."""
    return f"{count / 1e9:.1f} GB"
