"""What a long computation on the CPU wants of the process that runs it."""

from __future__ import annotations

import ctypes
import sys

import torch

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # malloc.h of glibc
_MMAP_BYTES, _KEPT_BYTES = 2**25, 2**30  # glibc takes no more than 32 MiB for the first


def settle_on_cpu() -> None:
    """Readies this process for training on the CPU; the results of computations stay what they are, nearly.

    Denormal numbers become zero: Adam's moments of what gets no gradient decay into them, and processors take up to
    100 times as long over each. And memory that a step frees is kept for the next one: handing every large tensor
    back to the system costs a page fault per 4 KiB, step after step (glibc's malloc alone; others keep it anyway).
    """
    torch.set_flush_denormal(True)
    if sys.platform == "linux":
        mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
        if mallopt is not None:
            mallopt(_M_MMAP_THRESHOLD, _MMAP_BYTES)
            mallopt(_M_TRIM_THRESHOLD, _KEPT_BYTES)
