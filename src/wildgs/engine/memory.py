"""Bounds the number of Gaussians by the memory that is free before training.

Methods declare what they use (`wildgs.model.config.MemoryUse`); `benchmarks/memory.py` measures it as the peak
resident memory of short trainings that differ in one size. Decoded photos have a limit of their own.
"""

from __future__ import annotations

import torch

from wildgs.errors import UserError
from wildgs.model.registry import MethodName, method_type
from wildgs.scene import Scene
from wildgs.scene.image_cache import available_memory

MARGIN = 0.9
"""Share of the free memory that may be planned with."""


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
        method: Name of the method.
        scene: The scene, whose photos have been read.
        budget: Upper bound on the number of Gaussians, as configured.
        device: Where training will run.
        explicit: Whether the user gave this budget: then it is never lowered.

    Returns:
        The budget, and a message for the user where it was lowered.

    Raises:
        UserError: The scene, or an explicit budget, does not fit.
    """
    pixels = max(view.camera.width * view.camera.height for view in scene.views)
    use, available = method_type(method).memory, free_memory(device)
    rest = use.fixed + pixels * use.per_pixel
    total = rest + budget * use.per_gaussian
    if available is None or total <= MARGIN * available:
        return budget, None
    fits = (int(MARGIN * available) - rest) // use.per_gaussian
    size = f"{pixels / 1e6:.1f} megapixels"
    needs = f"{budget:,} Gaussians on photos of {size} take about {gigabytes(total)}"
    least = min(budget, len(scene.points))
    if fits < least:
        raise UserError(
            f"{needs}, and {gigabytes(available)} are free, too little for the {least:,} Gaussians of the start: "
            f"raise --downscale, set --max-side, lower --image-cache, or lower --max-gaussians to {max(fits, 0):,}"
            if fits > 0
            else f"photos of {pixels / 1e6:.1f} megapixels do not fit into the {gigabytes(available)} that are "
            "free: raise --downscale, set --max-side, or lower --image-cache"
        )
    if explicit:
        raise UserError(
            f"{needs}, and {gigabytes(available)} are free: lower --max-gaussians to {fits:,}, raise --downscale, "
            "set --max-side, or leave --max-gaussians out"
        )
    return fits, f"{needs}, and {gigabytes(available)} are free: the budget is {fits:,} Gaussians"


def gigabytes(count: int) -> str:
    """Bytes as people read them."""
    return f"{count / 1e9:.1f} GB"
