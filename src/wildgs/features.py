"""Ways of computing on CUDA that can be switched off one by one, to compare them or to work around a fault.

`WILDGS_WITHOUT=triton_ssim,triton_planes` in the environment switches some of them off.
"""

from __future__ import annotations

import importlib.util
import os
from functools import cache

FEATURES = {
    "triton_ssim": "SSIM and its gradient in four Triton kernels; else by convolutions",
    "triton_planes": "the triplane sampled channels-last by Triton kernels; else by grid_sample",
    "spread_rejected": "pixels that are not lifted spread over many cells in the scatter; else all in one",
    "split_weights": "weight gradients of the fusion network summed in parts; else one product over all Gaussians",
    "checkpoint_thread": "checkpoints written by a thread; else by the training loop",
}


def is_on(name: str) -> bool:
    """Whether a feature is on.

    Raises:
        ValueError: There is no feature of that name.
    """
    if name not in FEATURES:
        raise ValueError(f"there is no feature {name!r}; they are {', '.join(FEATURES)}")
    return name not in os.environ.get("WILDGS_WITHOUT", "").replace(" ", "").split(",")


def has_triton(name: str) -> bool:
    """Whether a feature is on that needs Triton (in torch's CUDA builds for Linux) and an Ampere or newer GPU."""
    return is_on(name) and _runs_triton()


@cache
def _runs_triton() -> bool:
    import torch

    return importlib.util.find_spec("triton") is not None and torch.cuda.get_device_capability() >= (8, 0)
