"""Colours from spherical harmonics on the CPU: the autograd function around its kernels."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from wildgs.geometry.camera import Camera
from wildgs.rasterize.cpu import sh_kernels
from wildgs.threads import flat, launch

UNCLAMPED = -1e30
"""Finite stand-in for minus infinity, since the kernels are compiled with fast-math."""


class _Shade(torch.autograd.Function):
    """Autograd function of spherical harmonics of visible Gaussians."""

    @staticmethod
    def forward(
        ctx: Any, means: Tensor, sh: Tensor, eye: np.ndarray, degree: int, visible: np.ndarray, floor: float
    ) -> Any:
        out = torch.empty(len(means), 3)
        launch(
            sh_kernels.shade_forward,
            flat(means), flat(sh), sh.shape[1], degree, eye, visible, np.float32(floor), flat(out),
            items=-(-len(means) // sh_kernels.CHUNK),
        )  # fmt: skip
        ctx.save_for_backward(means, sh, out)
        ctx.rest = eye, degree, visible, floor
        return out

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> Any:
        means, sh, out = ctx.saved_tensors
        eye, degree, visible, floor = ctx.rest
        v_sh = torch.empty_like(sh, memory_format=torch.contiguous_format)
        v_means = (
            torch.empty_like(means, memory_format=torch.contiguous_format)
            if ctx.needs_input_grad[0]
            else None
        )
        launch(
            sh_kernels.shade_backward,
            flat(means), flat(sh), sh.shape[1], degree, eye, visible, np.float32(floor), flat(out), flat(grads[0]),
            flat(v_sh), None if v_means is None else flat(v_means),
            items=-(-len(means) // sh_kernels.CHUNK),
        )  # fmt: skip
        return v_means, v_sh, None, None, None, None


def sh_to_colors(
    means: Float[Tensor, "N 3"],
    sh: Float[Tensor, "N K 3"],
    camera: Camera,
    degree: int,
    visible: Bool[Tensor, "N"] | None,
    clamped: bool,
) -> Float[Tensor, "N 3"]:
    """See `wildgs.rasterize.sh_to_colors`."""
    if visible is None:
        visible = torch.ones(len(means), dtype=torch.bool)
    eye = flat(camera.position.detach().to("cpu", torch.float32))
    return _Shade.apply(means, sh, eye, degree, flat(visible), 0.0 if clamped else UNCLAMPED)  # type: ignore[return-value]
