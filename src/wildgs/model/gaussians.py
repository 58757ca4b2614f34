"""The explicit scene: N Gaussians, each a row in every per-Gaussian parameter."""

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
"""Near plane; the aligned frame's unit is the photos' median depth. What people in the way leave behind floats
right before single cameras: nearer than this there is nothing of a landmark to see."""


GEOMETRY_ROWS: dict[str, tuple[int, ...]] = {
    "means": (3,),
    "quats": (4,),
    "log_scales": (3,),
    "opacity_logits": (),
}
"""Rows that every method has, with the shape of one Gaussian's entry."""


class Gaussians(nn.Module):
    """Geometry of the Gaussians plus whatever per-Gaussian features a method adds.

    Every parameter in `rows` has N rows. Densification edits all of them together, so a feature that is
    registered here travels with clone, split and prune without further care.

    Stored values are raw: `log_scales` (exp gives world units), `opacity_logits` (sigmoid gives opacity),
    `quats` (w, x, y, z, not normalised).

    Attributes:
        rows: All parameters.
        eps2d: With which they are projected; see `wildgs.rasterize.project`.
    """

    def __init__(self, rows: dict[str, Tensor]) -> None:
        """Takes the initial values of all rows, `GEOMETRY_ROWS` among them."""
        super().__init__()
        self.eps2d = EPS2D
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
        """Standard deviations along the Gaussian's own axes, world units."""
        return self.rows["log_scales"].exp()

    @property
    def opacities(self) -> Float[Tensor, "N"]:
        """Opacities in (0, 1)."""
        return self.rows["opacity_logits"].sigmoid()

    def project(
        self, camera: Camera, *, absgrad: bool = False, factors: Float[Tensor, "N"] | None = None
    ) -> Projection:
        """Projects and bins all Gaussians for one camera; `factors` multiply their opacities, up to 0.999."""
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
        )


def geometry_from_points(points: Float[Tensor, "P 3"]) -> dict[str, Tensor]:
    """Initial geometry as 3D Gaussian Splatting starts: round Gaussians as wide as their neighbours are far.

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
"""Rows are shaded in multiples of this on the CPU, where libraries compile a matrix product for every new shape."""


def rows_to_shade(visible: Bool[Tensor, "N"]) -> Int[Tensor, " V"]:
    """Indices of the visible Gaussians; on the CPU also of a few others, up to a multiple of `ROWS_STEP`."""
    rows = visible.nonzero()[:, 0]
    if visible.device.type != "cpu":
        return rows
    missing = min(-len(rows) % ROWS_STEP, len(visible) - len(rows))
    if missing == 0:
        return rows
    return torch.cat([rows, (~visible).nonzero()[:missing, 0]])


def take_rows(values: Float[Tensor, "N *rest"], rows: Int[Tensor, " V"]) -> Float[Tensor, "V *rest"]:
    """``values[rows]`` for indices of which none comes twice.

    Its gradient is then written, not added up: indexing would sort the indices on a GPU to add in a fixed order.
    """
    return _TakeRows.apply(values, rows)


def spread_rows(
    values: Float[Tensor, "V *rest"], rows: Int[Tensor, " V"], count: int
) -> Float[Tensor, "N *rest"]:
    """The reverse of `take_rows`: values at their Gaussians' places, zero for the others."""
    return values.new_zeros(count, *values.shape[1:]).index_copy(0, rows, values)


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
