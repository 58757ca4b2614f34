"""Ways of computing on CUDA that can be switched off one by one, to compare them or to work around a fault.

`WILDGS_WITHOUT=triton_ssim,triton_planes` in the environment switches some of them off.
"""

from __future__ import annotations

import importlib.util
import os
import warnings
from collections.abc import Callable

from wildgs.errors import WildGSWarning

FEATURES = {
    "triton_ssim": "SSIM and its gradient in four Triton kernels; else by convolutions",
    "triton_planes": "the triplane sampled channels-last by Triton kernels; else by grid_sample",
    "spread_rejected": "pixels that are not lifted spread over many cells in the scatter; else all in one",
    "split_weights": "weight gradients of the fusion network summed in parts; else one product over all Gaussians",
    "written_gradients": "gradients of replayed graphs written by one autograd function; else one accumulator each",
    "skip_on_device": "fused Adam skips a step that is not finite by itself; else the host waits to judge it",
    "densify_once": "densification moves every tensor once, in its final order; else a second time to sort it",
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


def has_triton(name: str, probe: Callable[[], object]) -> bool:
    """Whether a feature is on that needs Triton (in torch's CUDA builds for Linux), and its kernels run here.

    They need an Ampere or newer GPU, and Triton needs a C compiler.

    Args:
        name: The feature.
        probe: Runs its kernels on the smallest input; called once in a process.
    """
    return is_on(name) and _runs(name, probe)


_runs_here: dict[str, bool] = {}


def _runs(name: str, probe: Callable[[], object]) -> bool:
    if name not in _runs_here:
        _runs_here[name] = _runs_triton() and _succeeds(name, probe)
    return _runs_here[name]


def _runs_triton() -> bool:
    import torch

    return importlib.util.find_spec("triton") is not None and torch.cuda.get_device_capability() >= (8, 0)


def _succeeds(name: str, probe: Callable[[], object]) -> bool:
    try:
        probe()
    except Exception as error:  # Triton, its compilers and the driver raise many kinds
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        warnings.warn(
            f"Triton kernels cannot be used here ({reason}); training continues without, slower "
            f"(WILDGS_WITHOUT={name} leaves them out)",
            WildGSWarning,
            stacklevel=4,
        )
        return False
    return True
