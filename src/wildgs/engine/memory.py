"""How much memory a training will take, before it takes it.

`benchmarks/memory.py` measures the constants: peak resident memory of short trainings that differ in one size. For
`3dgs` on the CPU it gave 2,095 bytes a Gaussian and 262 bytes a pixel, rounded up here; those of `wildgs` are
reckoned from the sizes of its tensors. They hold for what a step needs beside the decoded photos, which have a
limit of their own.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from wildgs.errors import UserError
from wildgs.model.registry import MethodName
from wildgs.scene import Scene
from wildgs.scene.image_cache import available_memory

BYTES_PER_GAUSSIAN: dict[MethodName, int] = {"wildgs": 6000, "3dgs": 2500}
"""Parameters, gradients, Adam's moments, the copies of densification, and one view's intermediate values."""
BYTES_PER_PIXEL: dict[MethodName, int] = {"wildgs": 700, "3dgs": 300}
FIXED_BYTES: dict[MethodName, int] = {"wildgs": 600 * 2**20, "3dgs": 100 * 2**20}
"""Networks with their moments and activations, and kernels; libraries are loaded already when this is asked."""
MARGIN = 0.9
"""Share of the free memory that may be planned with."""


@dataclass(frozen=True)
class MemoryEstimate:
    """What training takes beside the decoded photos, bytes.

    Attributes:
        method: What is trained.
        num_gaussians: At most so many.
        pixels: Of the largest photo, at the size at which it trains.
    """

    method: MethodName
    num_gaussians: int
    pixels: int

    @property
    def gaussians(self) -> int:
        """Share of the Gaussians."""
        return self.num_gaussians * BYTES_PER_GAUSSIAN[self.method]

    @property
    def total(self) -> int:
        """All of it."""
        return FIXED_BYTES[self.method] + self.pixels * BYTES_PER_PIXEL[self.method] + self.gaussians

    def largest_budget(self, available: int) -> int:
        """The most Gaussians for which `available` bytes suffice; below 0 where nothing does."""
        rest = int(MARGIN * available) - (self.total - self.gaussians)
        return rest // BYTES_PER_GAUSSIAN[self.method]


def free_memory(device: torch.device) -> int | None:
    """Free bytes where training will run; None where the system does not say."""
    if device.type == "cuda":
        return torch.cuda.mem_get_info(device)[0]
    return available_memory()


def plan_budget(
    method: MethodName, scene: Scene, wish: int, device: torch.device, *, explicit: bool
) -> tuple[int, str | None]:
    """A budget of Gaussians that fits, decided before training starts.

    Args:
        method: What will be trained.
        scene: Its photos are read already.
        wish: The budget as configured.
        device: Where.
        explicit: Whether the user asked for this budget: then it is not lowered silently.

    Returns:
        The budget, and what to tell where it is not the wish.

    Raises:
        UserError: The scene, or the budget that was asked for, cannot fit.
    """
    pixels = max(view.camera.width * view.camera.height for view in scene.views)
    estimate = MemoryEstimate(method, wish, pixels)
    available = free_memory(device)
    if available is None or estimate.total <= MARGIN * available:
        return wish, None
    fits = estimate.largest_budget(available)
    needs = f"{wish:,} Gaussians on photos of {pixels / 1e6:.1f} megapixels take about {gigabytes(estimate.total)}"
    least = min(wish, len(scene.points))
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
