"""Compiles the slowest kernels in advance, by calls without Gaussians and pixels."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import torch
from torch import Tensor

from wildgs.rasterize.cpu.blending import _Blend
from wildgs.rasterize.cpu.footprint_kernels import GROUP
from wildgs.rasterize.cpu.projection import TileLists, _Lens, _Project
from wildgs.rasterize.cpu.shading import _Shade


def compile_blending() -> None:
    """Compiles the kernels of blending three channels and depth, and of its gradient."""
    integers, numbers = np.empty(0, np.int32), np.empty(0, np.float32)
    starts, order = np.zeros(1, np.int64), np.empty(0, np.int64)
    tiles = TileLists(integers, integers, numbers, starts, starts, integers, order)
    image = SimpleNamespace(width=0, height=0)
    geometry = [_empty(0, 2), _empty(0, 3), _empty(0), _empty(0)]
    projection = SimpleNamespace(tiles=tiles, camera=image, depths=geometry[2], absgrad=None)
    pictures = _Blend.apply(*geometry, _empty(0, 3), torch.zeros(3), projection, True)
    assert pictures is not None
    torch.stack([picture.sum() for picture in pictures]).sum().backward()


def compile_gradients() -> None:
    """Compiles the kernels of the gradients of colours and of the projection."""
    colors = _Shade.apply(_empty(0, 3), _empty(0, 1, 3), np.zeros(3, np.float32), 0, np.empty(0, bool), 0.0)
    assert isinstance(colors, Tensor)
    colors.sum().backward()
    lens = _Lens(np.zeros(12, np.float32), np.zeros(6, np.float32), 1, 1)
    outputs = (
        torch.zeros(GROUP, 2),
        torch.zeros(GROUP),
        torch.zeros(GROUP, 3),
        torch.zeros(0),
        torch.zeros(GROUP, dtype=torch.int32),
    )
    projected = _Project.apply(_empty(GROUP, 3), _empty(GROUP, 4), _empty(GROUP, 3), lens, outputs)
    assert projected is not None
    torch.stack([value.sum() for value in projected]).sum().backward()


def _empty(*shape: int) -> Tensor:
    return torch.zeros(shape, requires_grad=True)
