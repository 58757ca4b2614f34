"""gsplat's functions as the package calls them, computed by its own CPU backend: a launch each way."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional
from torch.utils._python_dispatch import _disable_current_modes

from wildgs.geometry.camera import Camera
from wildgs.geometry.spherical_harmonics import sh_basis
from wildgs.rasterize import Projection, blend, project
from wildgs.rasterize.interface import TILE

from .tensors import RECORD, Pretended


class _Kernel(torch.autograd.Function):
    """A function of CPU tensors as one operation on pretended ones."""

    @staticmethod
    def forward(ctx: Any, name: str, function: Callable[..., tuple[Tensor, ...]], *tensors: Any) -> Any:
        RECORD.launch(f"gsplat: {name}")
        leaves = [_leaf(tensor) if isinstance(tensor, Pretended) else tensor for tensor in tensors]
        with torch.enable_grad(), _disable_current_modes():
            outputs = function(*leaves)
        ctx.name, ctx.leaves, ctx.outputs = name, leaves, outputs
        return tuple(Pretended(output.detach()) for output in outputs)

    @staticmethod
    def backward(ctx: Any, *gradients: Any) -> Any:
        RECORD.launch(f"gsplat: {ctx.name}, backward")
        wanted = [leaf for leaf in ctx.leaves if isinstance(leaf, Tensor) and leaf.requires_grad]
        pairs = [
            (output, gradient.inner)
            for output, gradient in zip(ctx.outputs, gradients, strict=True)
            if output.requires_grad and gradient is not None
        ]
        with _disable_current_modes():
            found = torch.autograd.grad(
                [output for output, _ in pairs],
                wanted,
                [gradient for _, gradient in pairs],
                allow_unused=True,
                retain_graph=True,  # density control asks for another gradient of the same blend
            )
        by_leaf = {id(leaf): gradient for leaf, gradient in zip(wanted, found, strict=True)}
        given = (by_leaf.get(id(leaf)) for leaf in ctx.leaves)
        return (None, None, *(None if gradient is None else Pretended(gradient) for gradient in given))


def _leaf(tensor: Pretended) -> Tensor:
    leaf = tensor.inner.detach()
    return leaf.clone().requires_grad_(tensor.requires_grad) if leaf.is_floating_point() else leaf


class StandIn:
    """Stands for the module gsplat. One picture at a time, no packed mode."""

    def __init__(self) -> None:
        self.projection: Projection | None = None

    def fully_fused_projection(
        self, means: Tensor, _: None, quats: Tensor, scales: Tensor, view: Tensor, K: Tensor,
        width: int, height: int, *, eps2d: float, near_plane: float, packed: bool, opacities: Tensor,
        calc_compensations: bool,
    ) -> Any:  # fmt: skip
        """Radii, centres, depths, conics and compensations."""
        assert isinstance(view, Pretended)
        assert isinstance(K, Pretended)
        camera = Camera(view.inner[0].clone(), K.inner[0].clone(), width, height)

        def compute(*geometry: Tensor) -> tuple[Tensor, ...]:
            seen = self.projection = project(
                *geometry,
                camera,
                backend="cpu",
                near=near_plane,
                eps2d=eps2d,
                antialiased=calc_compensations,
            )
            radii = seen.radii.int()[None, :, None].expand(-1, -1, 2)
            values = radii, seen.means2d[None], seen.depths[None], seen.conics[None]
            if not calc_compensations:
                return values
            compensations = torch.where(seen.visible, seen.opacities / geometry[3].clamp(1e-6, 1), 0)
            return *values, compensations[None]

        found = _Kernel.apply("project", compute, means, quats, scales, opacities)
        return found if calc_compensations else (*found, None)

    def isect_tiles(self, *_: Any, **__: Any) -> Any:
        """Tile lists are in the projection already; gsplat's host waits for their length here."""
        RECORD.launch("gsplat: intersect and sort")
        RECORD.wait("gsplat's number of intersections")
        ids = Pretended(torch.zeros(1, dtype=torch.int64))
        return None, ids, ids

    def isect_offset_encode(self, _: Tensor, images: int, columns: int, rows: int) -> Tensor:
        """See `isect_tiles`."""
        RECORD.launch("gsplat: offsets")
        return Pretended(torch.zeros(images, rows, columns, dtype=torch.int32))

    def rasterize_to_pixels(
        self, means2d: Tensor, conics: Tensor, values: Tensor, opacities: Tensor, *_: Any,
        masks: Tensor | None, packed: bool, absgrad: bool,
    ) -> Any:  # fmt: skip
        """Sums of values, and alpha, which is not written in tiles that are masked."""
        assert self.projection is not None
        seen = dataclasses.replace(self.projection, depths=self.projection.depths.detach())

        def compute(means2d: Tensor, conics: Tensor, values: Tensor, opacities: Tensor) -> Any:
            moved = dataclasses.replace(seen, means2d=means2d[0], conics=conics[0], opacities=opacities[0])
            rendering = blend(moved, values[0], depth=False)
            colors, alpha = rendering.colors, rendering.alpha
            if masks is not None:
                assert isinstance(masks, Pretended)
                there = masks.inner[0].repeat_interleave(TILE, 0).repeat_interleave(TILE, 1)
                there = there[: alpha.shape[0], : alpha.shape[1]]
                colors = torch.where(there[..., None], colors, 0)
                alpha = torch.where(there, alpha, torch.nan)
            return colors[None], alpha[None, ..., None]

        return _Kernel.apply("rasterise", compute, means2d, conics, values, opacities)

    def spherical_harmonics(
        self, degree: int, directions: Tensor, sh: Tensor, *, masks: Tensor | None
    ) -> Tensor:
        """Colours around zero."""

        def compute(directions: Tensor, sh: Tensor, seen: Tensor | None) -> tuple[Tensor]:
            basis = sh_basis(degree, functional.normalize(directions, dim=-1))
            colors = (basis[..., None] * sh[:, : basis.shape[1]]).sum(1)
            return (colors if seen is None else torch.where(seen[:, None], colors, 0.0),)

        return _Kernel.apply("harmonics", compute, directions, sh, masks)[0]
