"""This process: its place among those that torchrun started, and its environment. Imports nothing large."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

LIBRARY_DEFAULTS = {
    # oneDNN compiles a convolution or matrix product for every size and keeps the last 1,024. A collection of
    # photos of many sizes needs more: two thirds of every step went into compiling again.
    "ONEDNN_PRIMITIVE_CACHE_CAPACITY": "8192",
    # By default MKL's order of addition depends on where in memory a matrix lies, and two equal trainings, or one
    # that was resumed, differ in the last bit.
    "MKL_CBWR": "AUTO,STRICT",
}


@contextmanager
def library_environment() -> Iterator[None]:
    """Sets `LIBRARY_DEFAULTS` where the environment has no value of its own, for as long as the block runs.

    oneDNN and MKL read them at their first call in the process and never again.
    """
    added = [name for name in LIBRARY_DEFAULTS if name not in os.environ]
    os.environ.update({name: LIBRARY_DEFAULTS[name] for name in added})
    try:
        yield
    finally:
        for name in added:
            os.environ.pop(name, None)


def world_size() -> int:
    """How many processes were started together; 1 without torchrun."""
    return int(os.environ.get("WORLD_SIZE", "1")) if "RANK" in os.environ else 1


def rank() -> int:
    """This process's number among all, from 0."""
    return int(os.environ["RANK"]) if world_size() > 1 else 0


def local_rank() -> int:
    """This process's number among those on this machine, from 0."""
    return int(os.environ.get("LOCAL_RANK", "0")) if world_size() > 1 else 0


def local_world_size() -> int:
    """How many of the processes run on this machine."""
    return max(1, int(os.environ.get("LOCAL_WORLD_SIZE", "1"))) if world_size() > 1 else 1
