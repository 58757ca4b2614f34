"""Limits the number of Gaussians by the memory that is free before training.

Methods declare their memory use (`wildgs.model.config.MemoryUse`); `benchmarks/memory.py` measures it as the peak
resident memory of short trainings that differ in one size. The cache of decoded photos has its own limit.
"""

from __future__ import annotations

import torch

from wildgs.errors import UserError
from wildgs.model.registry import MethodName, method_type
from wildgs.scene import Scene
from wildgs.scene.image_cache import available_memory

MARGIN = 0.9
"""Fraction of the free memory that may be used."""


def free_memory(device: torch.device) -> int | None:
    """Free memory of a device in bytes; None if unknown."""
    if device.type == "cuda":
        return torch.cuda.mem_get_info(device)[0]
    return available_memory()


def plan_budget(
    method: MethodName, scene: Scene, budget: int, device: torch.device, *, explicit: bool
) -> tuple[int, str | None]:
    """An upper bound on the number of Gaussians that fits into the free memory.

    Args:
        method: Name of the method.
        scene: The scene, whose photos have been read.
        budget: The configured upper bound on the number of Gaussians.
        device: Device of training.
        explicit: Whether the user gave this bound; then it is never lowered.

    Returns:
        The bound, and a message for the user if it was lowered.

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
    needs = f"{budget:,} Gaussians on photos of {size} need about {gigabytes(total)}"
    least = min(budget, len(scene.points))
    if fits < least:
        raise UserError(
            f"{needs}, but {gigabytes(available)} are free, too little for the {least:,} initial Gaussians: "
            f"raise --downscale, set --max-side, lower --image-cache, or lower --max-gaussians to {max(fits, 0):,}"
            if fits > 0
            else f"photos of {pixels / 1e6:.1f} megapixels do not fit into the {gigabytes(available)} that are "
            "free: raise --downscale, set --max-side, or lower --image-cache"
        )
    if explicit:
        raise UserError(
            f"{needs}, but {gigabytes(available)} are free: lower --max-gaussians to {fits:,}, raise --downscale, "
            "set --max-side, or leave --max-gaussians out"
        )
    return fits, f"{needs}, but {gigabytes(available)} are free: limited to {fits:,} Gaussians"


def gigabytes(count: int) -> str:
    """Formats bytes as GB."""
    return f"{count / 1e9:.1f} GB"
