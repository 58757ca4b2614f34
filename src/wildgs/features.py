"""Optimisations for CUDA that can be switched off one by one, for comparisons or to work around a bug.

The environment variable `WILDGS_WITHOUT=triton_ssim,triton_planes` switches some of them off.
"""

from __future__ import annotations

import importlib.util
import os
import warnings
from collections.abc import Callable

from wildgs.errors import WildGSWarning

FEATURES = {
    "triton_ssim": "SSIM and its gradient by four Triton kernels instead of convolutions",
    "triton_planes": "channels-last triplane sampling by Triton kernels instead of grid_sample",
    "spread_rejected": "spreads pixels that are not lifted over many cells of the scatter instead of one",
    "split_weights": "sums weight gradients of the fusion network in parts instead of by one large product",
    "written_gradients": "writes gradients of replayed graphs by one autograd function instead of accumulators",
    "skip_on_device": "skips non-finite steps on the device by fused Adam instead of waiting for the host",
    "densify_once": "moves every tensor once in densification, in its final order, instead of twice",
    "checkpoint_thread": "writes checkpoints in a thread instead of the training loop",
}


def is_on(name: str) -> bool:
    """Whether a feature is on.

    Raises:
        ValueError: The name is unknown.
    """
    if name not in FEATURES:
        raise ValueError(f"unknown feature {name!r}; choose from {', '.join(FEATURES)}")
    return name not in os.environ.get("WILDGS_WITHOUT", "").replace(" ", "").split(",")


def has_triton(name: str, probe: Callable[[], object]) -> bool:
    """Whether a feature that needs Triton is on and its kernels run on this machine.

    Requires an Ampere or newer GPU, torch's CUDA build for Linux (which includes Triton) and a C compiler.

    Args:
        name: The feature.
        probe: Runs its kernels on a minimal input; called once per process.
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
    except Exception as error:  # Triton, its compilers and the driver raise many types
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        warnings.warn(
            f"Triton kernels do not work here ({reason}); training continues without them and is slower "
            f"(WILDGS_WITHOUT={name} switches them off)",
            WildGSWarning,
            stacklevel=4,
        )
        return False
    return True
