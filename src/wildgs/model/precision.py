"""Mixed precision for the networks alone; geometry and rasterisation always run in float32."""

from __future__ import annotations

from contextlib import AbstractContextManager

import torch
from torch import nn

from wildgs.model.config import Precision
from wildgs.model.replays import Replays


class MixedModule(nn.Module):
    """A network whose forward pass may run in bfloat16, and be replayed as a CUDA graph."""

    precision: torch.dtype = torch.float32

    def __init__(self) -> None:
        super().__init__()
        self.replays = Replays()

    def mixed(self, device: torch.device) -> AbstractContextManager[object]:
        """Autocast to this module's precision."""
        enabled = self.precision != torch.float32
        dtype = self.precision if enabled else None
        # Every weight is read once, so nothing is gained by keeping it; and graphs must not be recorded from what
        # was kept.
        return torch.autocast(device.type, dtype=dtype, enabled=enabled, cache_enabled=False)


def set_precision(module: nn.Module, precision: torch.dtype) -> None:
    """Sets the precision of all networks inside a module."""
    for part in module.modules():
        if isinstance(part, MixedModule):
            part.precision = precision


def switch_replays(module: nn.Module, on: bool) -> None:
    """Whether the networks inside a module record and replay CUDA graphs where they run on CUDA."""
    for part in module.modules():
        if isinstance(part, MixedModule):
            part.replays.switch(on)


def lay_out_channels_last(module: nn.Module) -> None:
    """Lays out the networks' convolutions channels-last: faster on CPUs and on tensor cores.

    Call it before optimisers are made, whose state follows the parameters' layout.
    """
    for part in module.modules():
        if isinstance(part, MixedModule):
            part.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]


def choose_precision(precision: Precision, device: torch.device) -> torch.dtype:
    """The dtype of a configured precision: 'auto' is bfloat16 where the hardware multiplies it fast.

    On CPUs that is AVX-512 BF16 or AMX, on NVIDIA GPUs Ampere or newer; elsewhere bfloat16 is emulated and slower
    than float32.
    """
    if precision != "auto":
        return torch.bfloat16 if precision == "bfloat16" else torch.float32
    if device.type == "cuda":
        fast = torch.cuda.is_bf16_supported(including_emulation=False)
        return torch.bfloat16 if fast else torch.float32
    probe = getattr(torch.cpu, "_is_avx512_bf16_supported", None)
    return torch.bfloat16 if probe is not None and probe() else torch.float32
