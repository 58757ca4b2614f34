"""Carrying what a step needs to the device without waiting for what the device still does."""

from __future__ import annotations

import torch
from torch import Tensor


def upload(tensor: Tensor, device: torch.device) -> Tensor:
    """A tensor in main memory, on the device.

    A copy from pageable memory would wait until the device has done all it was told before.
    """
    if device.type == "cpu":
        return tensor
    return tensor.pin_memory().to(device, non_blocking=True)
