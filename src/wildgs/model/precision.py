"""Mixed precision of the networks; geometry and rasterisation always use float32."""

from __future__ import annotations

from contextlib import AbstractContextManager

import torch
from torch import nn

from wildgs.model.config import Precision
from wildgs.model.replays import Replays


class MixedModule(nn.Module):
    """A network whose forward pass may run in bfloat16 and be replayed as a CUDA graph."""

    precision: torch.dtype = torch.float32

    def __init__(self) -> None:
        super().__init__()
        self.replays = Replays()

    def mixed(self, device: torch.device) -> AbstractContextManager[object]:
        """Autocast to this module's precision."""
        enabled = self.precision != torch.float32
        dtype = self.precision if enabled else None
        # No weight cache: every weight is used once, and CUDA graphs must not capture cached copies.
        return torch.autocast(device.type, dtype=dtype, enabled=enabled, cache_enabled=False)


def set_precision(module: nn.Module, precision: torch.dtype) -> None:
    """Sets the precision of all networks inside a module."""
    for part in module.modules():
        if isinstance(part, MixedModule):
            part.precision = precision


def switch_replays(module: nn.Module, on: bool) -> None:
    """Switches capturing and replaying of CUDA graphs on or off for all networks inside a module."""
    for part in module.modules():
        if isinstance(part, MixedModule):
            part.replays.switch(on)


def lay_out_channels_last(module: nn.Module) -> None:
    """Converts the networks to the channels-last memory format, which is faster on CPUs and tensor cores.

    Must be called before optimisers are created, whose state has the parameters' memory format.
    """
    for part in module.modules():
        if isinstance(part, MixedModule):
            part.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]


def choose_precision(precision: Precision, device: torch.device) -> torch.dtype:
    """The dtype of a configured precision: 'auto' is bfloat16 on hardware that accelerates it.

    That is CPUs with AVX-512 BF16 or AMX, and NVIDIA GPUs from Ampere on; elsewhere bfloat16 is emulated and slower
    than float32.
    """
    if precision != "auto":
        return torch.bfloat16 if precision == "bfloat16" else torch.float32
    if device.type == "cuda":
        fast = torch.cuda.is_bf16_supported(including_emulation=False)
        return torch.bfloat16 if fast else torch.float32
    probe = getattr(torch.cpu, "_is_avx512_bf16_supported", None)
    return torch.bfloat16 if probe is not None and probe() else torch.float32
