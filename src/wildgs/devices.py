"""Copying tensors to a GPU."""

from __future__ import annotations

import torch
from torch import Tensor


def upload(tensor: Tensor, device: torch.device) -> Tensor:
    """Copies a CPU tensor to a device, from pinned memory if that is a GPU.

    A copy from pageable memory would wait for all work queued on the GPU.
    """
    if device.type == "cuda":
        return tensor.pin_memory().to(device, non_blocking=True)
    return tensor.to(device)
