"""Torch's recorder of CUDA graphs, emulated on the CPU: operations are noted and done again."""

from __future__ import annotations

from contextlib import contextmanager, nullcontext
from typing import Any

import pytest
import torch

from benchmarks.pretend_cuda import graphs


def emulate_graphs(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Emulates the recorder for a test; gives the capture mode of every graph that was captured."""
    modes: list[str] = []

    @contextmanager
    def graph(captured: graphs.CUDAGraph, *, pool: Any, capture_error_mode: str):
        assert pool == (0, 1)
        with graphs.graph(captured, pool=pool, capture_error_mode=capture_error_mode):
            yield
        modes.append(capture_error_mode)

    for name, value in {
        "graph_pool_handle": lambda: (0, 1),
        "synchronize": lambda: None,
        "Stream": lambda: None,
        "current_stream": lambda: None,
        "stream": nullcontext,
        "CUDAGraph": graphs.CUDAGraph,
        "graph": graph,
    }.items():
        monkeypatch.setattr(torch.cuda, name, value)
    return modes
