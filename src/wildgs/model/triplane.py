"""The triplane: orthographic projections of a coloured point cloud, and sampling of feature planes at points.

Planes are XY, YZ and ZX of the aligned frame, in this order everywhere. On plane (a, b) the column of a cell
follows axis a and the row follows axis b; the projection is along the third axis.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

from wildgs import features
from wildgs.model.sampling_kernels import sample_backward, sample_forward
from wildgs.threads import launch

PLANE_AXES = ((0, 1), (1, 2), (2, 0))
VIEW_AXIS = (2, 0, 1)
PICTURE_CHANNELS = 4
"""Channels: red, green, blue, validity."""
POINTS_PER_ITEM = 1024
REJECTED_CELLS = 4096


@dataclass(frozen=True)
class Box:
    """An axis-aligned bounding box (AABB) in the scene's aligned frame.

    Attributes:
        low: Lower corner.
        high: Upper corner.
    """

    low: Float[Tensor, "3"]
    high: Float[Tensor, "3"]

    def normalize(self, points: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
        """Coordinates normalised to [-1, 1] inside the box: the paper's P̃."""
        return (points - self.low) / (self.high - self.low) * 2 - 1

    def contains(self, points: Float[Tensor, "N 3"]) -> Bool[Tensor, "N"]:
        """Which points lie inside."""
        return ((points >= self.low) & (points <= self.high)).all(dim=-1)


def robust_box(points: Float[Tensor, "P 3"], quantile: float, ratio: float) -> Box:
    """The bounding box of most points, scaled about their median (paper, Efficient Triplane Sampling).

    Args:
        points: SfM points, possibly with distant outliers.
        quantile: Fraction of points outside the box at each end of each axis.
        ratio: Crop ratio, the factor on the box's sides.
    """
    ordered = points.sort(dim=0).values
    last = len(points) - 1
    low = ordered[round(quantile * last)]
    high = ordered[round((1 - quantile) * last)]
    middle = ordered[last // 2]
    reach = (high - low).max().clamp_min(0.01)
    low = torch.minimum(middle + ratio * (low - middle), middle - 0.01 * reach)
    high = torch.maximum(middle + ratio * (high - middle), middle + 0.01 * reach)
    return Box(low, high)


def project_cloud(
    points: Float[Tensor, "P 3"],
    colors: Float[Tensor, "P 3"],
    resolution: int,
    keep: Bool[Tensor, " P"] | None = None,
) -> Float[Tensor, "3 2 4 R R"]:
    """Orthographic projections of a coloured cloud: c and c' on XY, YZ and ZX (paper, Triplane Color Creation).

    Each cell gets the colour of the point nearest to the viewer. Both directions of a plane share the grid (c' is
    not mirrored), so that a cell stands for the same line in space in c and c'.

    Args:
        points: Normalised positions; those outside [-1, 1] are ignored.
        colors: RGB in [0, 1].
        resolution: Cells per side, R.
        keep: Mask of the points to use; None for all.

    Returns:
        For each plane, the image seen from the positive end of the third axis (c), then from the negative end (c').
        Channels are red, green, blue, validity; empty cells are zero.
    """
    inside = (points.abs() <= 1).all(dim=-1)
    if keep is not None:
        inside = inside & keep
    if points.device.type == "cpu":
        # On a GPU, selecting points would synchronise.
        points, colors, inside = points[inside], colors[inside], inside[inside]
    if len(points) == 0:
        return colors.new_zeros(3, 2, PICTURE_CHANNELS, resolution, resolution)
    winner, hit = _nearest_per_cell(points, inside, resolution)
    filled = torch.cat([colors, torch.ones_like(colors[:, :1])], dim=1)
    pictures = torch.where(hit[:, None], filled.index_select(0, winner), 0.0)
    return pictures.reshape(3, 2, resolution, resolution, PICTURE_CHANNELS).permute(0, 1, 4, 2, 3)


def _nearest_per_cell(
    points: Float[Tensor, "P 3"], inside: Bool[Tensor, " P"], resolution: int
) -> tuple[Int[Tensor, " M"], Bool[Tensor, " M"]]:
    """For each cell of all six images: the index of the nearest point, and whether there is one."""
    count = resolution * resolution
    cells = ((points.T + 1) * (0.5 * resolution)).long().clamp_(0, resolution - 1)
    heights = torch.stack([points[:, axis] for axis in VIEW_AXIS])
    columns, rows = (torch.stack([cells[axes[i]] for axes in PLANE_AXES]) for i in (0, 1))
    index = torch.arange(points.shape[0], device=points.device)
    # Ignored points get additional cells at the end, several of them to avoid contention of atomics.
    spread = REJECTED_CELLS if features.is_on("spread_rejected") else 1
    cell = torch.where(inside, rows * resolution + columns, count + index % spread)[:, None].expand(-1, 2, -1)
    # Distance in the upper and index in the lower bits, so that scatter-min gives the index of the nearest point.
    distance = torch.stack([1 - heights, 1 + heights], dim=1)
    ordinal = (distance * (2**30 - 1)).long().clamp_(0, 2**31 - 2)
    key = (ordinal << 32) | index
    none = torch.iinfo(torch.int64).max
    best = torch.full((3, 2, count + spread), none, device=points.device).scatter_reduce(2, cell, key, "amin")
    best = best[..., :count].reshape(-1)
    hit = best != none
    return torch.where(hit, best & 0xFFFFFFFF, 0), hit


def sample_planes(planes: Float[Tensor, "3 C R R"], points: Float[Tensor, "N 3"]) -> Float[Tensor, "N C"]:
    """f_xy + f_yz + f_zx: the sum of bilinear samples of the three planes at points.

    Differentiable in the planes; the points get no gradient.

    Args:
        planes: Feature maps of XY, YZ and ZX.
        points: Normalised positions in [-1, 1]; cell centres are at (2 i + 1) / R - 1, and the border is repeated
            beyond the outermost centres.
    """
    if planes.device.type == "cpu" and planes.dtype == torch.float32:
        return _SampleOnCPU.apply(planes, points)
    if planes.is_cuda and planes.dtype == torch.float32 and _has_triton(planes, points):
        return _triton(planes, points)
    x, y, z = points.detach().unbind(1)  # indexing by lists would synchronise with a GPU
    grid = torch.stack([x, y, y, z, z, x], dim=1).reshape(-1, 3, 2).permute(1, 0, 2)
    sampled = functional.grid_sample(
        planes, grid[:, None], mode="bilinear", padding_mode="border", align_corners=False
    )
    return sampled.sum(dim=0)[:, 0].T


def _has_triton(planes: Tensor, points: Tensor) -> bool:
    return features.has_triton("triton_planes", lambda: _triton(planes[..., :1, :1], points.new_zeros(1, 3)))


def _triton(planes: Tensor, points: Tensor) -> Tensor:
    from wildgs.model.triplane_triton import TritonSample

    return TritonSample.apply(planes, points)


class _SampleOnCPU(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, planes: Tensor, points: Tensor) -> Tensor:
        cells = planes.detach().permute(0, 2, 3, 1).contiguous()
        points = points.detach().contiguous()
        out = torch.empty(len(points), planes.shape[1])
        launch(sample_forward, cells.numpy(), points.numpy(), POINTS_PER_ITEM, out.numpy())
        ctx.save_for_backward(points)
        ctx.shape = cells.shape
        return out

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        (points,) = ctx.saved_tensors
        out = torch.zeros(ctx.shape)
        launch(sample_backward, gradients[0].contiguous().numpy(), points.numpy(), out.numpy())
        return out.permute(0, 3, 1, 2), None
