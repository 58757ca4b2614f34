"""Carrying tensors to a GPU."""

from __future__ import annotations

import torch
from torch import Tensor


def upload(tensor: Tensor, device: torch.device) -> Tensor:
    """A tensor in main memory, on a device.

    To a GPU it is copied from pinned memory: a copy from pageable memory waits for all work queued before.
    """
    if device.type == "cuda":
        return tensor.pin_memory().to(device, non_blocking=True)
    return tensor.to(device)
