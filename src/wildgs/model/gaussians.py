"""The Gaussians and their per-Gaussian parameters."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from torch import Tensor, nn

from wildgs.geometry.camera import Camera
from wildgs.rasterize import EPS2D, Projection, project

INITIAL_OPACITY = 0.1
NEAR = 0.05
"""Near plane in units of the aligned frame (median depth of the photos = 1). Closer Gaussians are floaters, caused
by passers-by, in front of single cameras."""

GEOMETRY_ROWS: dict[str, tuple[int, ...]] = {
    "means": (3,),
    "quats": (4,),
    "log_scales": (3,),
    "opacity_logits": (),
}
"""Per-Gaussian parameters that every method has, with the shape of one entry."""


class Gaussians(nn.Module):
    """Geometry of the Gaussians, and the per-Gaussian features of a method.

    Every parameter in `rows` has N rows, and densification edits all of them, so that features need no further code
    for cloning, splitting and pruning.

    Values are stored before activation: `log_scales` (exp), `opacity_logits` (sigmoid), `quats` (w, x, y, z, not
    normalised).

    Attributes:
        rows: All parameters.
        photos: Effective number of training photos that show each Gaussian, edited together with `rows`; None until
            they are counted (`wildgs.engine.photo_counts`).
        eps2d: Added to the diagonal of 2D covariances; see `wildgs.rasterize.project`.
        antialiased: Whether opacities compensate for it; see `wildgs.rasterize.project`.
    """

    def __init__(self, rows: dict[str, Tensor]) -> None:
        """Creates the parameters from initial values, which include `GEOMETRY_ROWS`."""
        super().__init__()
        self.eps2d, self.antialiased = EPS2D, False
        self.photos: Float[Tensor, "N"] | None = None
        self.rows = nn.ParameterDict({name: nn.Parameter(value) for name, value in rows.items()})

    def __len__(self) -> int:
        return self.rows["means"].shape[0]

    @property
    def means(self) -> Float[Tensor, "N 3"]:
        """Centres in the scene's aligned frame."""
        return self.rows["means"]

    @property
    def quats(self) -> Float[Tensor, "N 4"]:
        """Orientations (w, x, y, z), not normalised."""
        return self.rows["quats"]

    @property
    def scales(self) -> Float[Tensor, "N 3"]:
        """Standard deviations along the principal axes, world units."""
        return self.rows["log_scales"].exp()

    @property
    def opacities(self) -> Float[Tensor, "N"]:
        """Opacities in (0, 1)."""
        return self.rows["opacity_logits"].sigmoid()

    def project(
        self, camera: Camera, *, absgrad: bool = False, factors: Float[Tensor, "N"] | None = None
    ) -> Projection:
        """Projects and bins all Gaussians for one camera; `factors` multiply opacities (at most 0.999)."""
        opacities = self.opacities if factors is None else (self.opacities * factors).clamp(max=0.999)
        return project(
            self.means,
            self.quats,
            self.scales,
            opacities,
            camera,
            near=NEAR,
            absgrad=absgrad,
            eps2d=self.eps2d,
            antialiased=self.antialiased,
        )


def geometry_from_points(points: Float[Tensor, "P 3"]) -> dict[str, Tensor]:
    """Initial geometry as in 3DGS: isotropic Gaussians whose size is the distance to their neighbours.

    Args:
        points: Sparse SfM points, world units.

    Returns:
        Rows for `Gaussians`: means, quats, log_scales (mean distance to the three nearest points) and
        opacity_logits.
    """
    count = points.shape[0]
    neighbours = min(4, count)
    distances, _ = KDTree(points.numpy()).query(points.numpy(), k=neighbours, workers=-1)
    nearest = torch.from_numpy(distances).reshape(count, neighbours)[:, 1:].float()
    spacing = (nearest.square().mean(dim=1)).sqrt() if neighbours > 1 else torch.ones(count)
    spacing = spacing.clamp(1e-4, max(float(spacing.median()) * 20, 1e-4))
    quats = torch.zeros(count, 4)
    quats[:, 0] = 1.0
    return {
        "means": points.float().clone(),
        "quats": quats,
        "log_scales": spacing.log()[:, None].repeat(1, 3),
        "opacity_logits": torch.full((count,), INITIAL_OPACITY).logit(),
    }


ROWS_STEP = 1024
"""On the CPU, rows are shaded in multiples of this, because oneDNN compiles matrix products for every new shape."""


def rows_to_shade(visible: Bool[Tensor, "N"], among: Bool[Tensor, "N"] | None = None) -> Int[Tensor, " V"]:
    """Indices of the visible Gaussians, on the CPU padded by others to a multiple of `ROWS_STEP`.

    Args:
        visible: Visible Gaussians.
        among: Gaussians from which the others are taken; None for all.
    """
    rows = visible.nonzero()[:, 0]
    if visible.device.type != "cpu" or len(rows) % ROWS_STEP == 0:
        return rows
    others = ~visible if among is None else among & ~visible
    return torch.cat([rows, others.nonzero()[: -len(rows) % ROWS_STEP, 0]])


def rows_by_group(visible: Bool[Tensor, "N"], group: Bool[Tensor, "N"]) -> tuple[Int[Tensor, " V"], int]:
    """Like `rows_to_shade`, first all rows outside of a group, then those of the group.

    Args:
        visible: Visible Gaussians.
        group: The group.

    Returns:
        Indices, and how many of them are outside of the group.
    """
    outside = ~group
    if visible.device.type == "cpu":
        first = rows_to_shade(visible & outside, outside)
        return torch.cat([first, rows_to_shade(visible & group, group)]), len(first)
    # One synchronisation, for both sizes.
    first, second = torch.stack([visible & outside, visible & group]).sum(dim=1).tolist()
    keys = torch.where(visible, group, 2).to(torch.uint8)
    return keys.argsort(stable=True)[: first + second], first


def take_rows(values: Float[Tensor, "N *rest"], rows: Int[Tensor, " V"]) -> Float[Tensor, "V *rest"]:
    """``values[rows]`` for unique indices.

    The gradient is written without accumulation, for which indexing would sort the indices on a GPU.
    """
    return _TakeRows.apply(values, rows)


def spread_rows(
    values: Float[Tensor, "V *rest"], rows: Int[Tensor, " V"], count: int
) -> Float[Tensor, "N *rest"]:
    """The inverse of `take_rows`; other Gaussians get zero."""
    return values.new_zeros(count, *values.shape[1:]).index_copy_(0, rows, values)


class _TakeRows(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, rows: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx.save_for_backward(rows)
        ctx.count = len(values)
        return values.index_select(0, rows)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:  # pyright: ignore[reportIncompatibleMethodOverride]
        (rows,) = ctx.saved_tensors
        return gradient.new_zeros(ctx.count, *gradient.shape[1:]).index_copy_(0, rows, gradient), None
