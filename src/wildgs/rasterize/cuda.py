"""The CUDA backend: gsplat 1.5 behind this package's interface. Imported only when it is asked for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from wildgs.errors import UserError
from wildgs.geometry.camera import Camera
from wildgs.rasterize.interface import DILATION, Projection, Rendering

if TYPE_CHECKING:
    from collections.abc import Iterable

TILE = 16
_LEAST_ALPHA = 1e-10


def _gsplat() -> Any:
    try:
        import gsplat
    except ImportError as error:
        raise UserError(
            "the CUDA rasteriser needs gsplat: pip install 'wildgs[cuda]', or choose the backend 'cpu'"
        ) from error
    return gsplat


@dataclass(frozen=True)
class _Tiles:
    """gsplat's sorted intersections of one picture.

    Attributes:
        offsets: Where each tile's list starts.
        flatten_ids: Gaussians (in packed mode: rows of `rows`) tile by tile, nearest first.
        rows: In packed mode the Gaussians that are seen; else None.
    """

    offsets: Tensor
    flatten_ids: Tensor
    rows: Tensor | None


def _finite(means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor) -> tuple[Tensor, ...]:
    """The same Gaussians, those that are not finite made transparent, whereupon gsplat culls them."""
    with torch.no_grad():
        # Finite where all of its terms are: infinity and NaN survive any addition.
        sound = (means.sum(-1) + quats.sum(-1) + scales.sum(-1) + opacities).isfinite()
        row = sound[:, None]
        turned = row & quats.any(-1, keepdim=True)
    return (
        torch.where(row, means, 0),
        torch.where(turned, quats, 1),
        torch.where(row, scales, 0),
        torch.where(sound, opacities, 0).clamp(max=1),
    )


def project(
    means: Float[Tensor, "N 3"],
    quats: Float[Tensor, "N 4"],
    scales: Float[Tensor, "N 3"],
    opacities: Float[Tensor, "N"],
    camera: Camera,
    near: float,
    absgrad: bool,
    packed: bool = False,
) -> Projection:
    """See `wildgs.rasterize.project`."""
    gsplat = _gsplat()
    n = len(means)
    if n == 0:
        empty = means.new_zeros(0)
        return _projection(camera, means[:, :2], empty, means, opacities, empty.int(), None, absgrad)
    means, quats, scales, visible_opacities = _finite(means, quats, scales, opacities)
    view, K = (t.to(means)[None] for t in (camera.viewmat, camera.K))
    result = gsplat.fully_fused_projection(
        means, None, quats, scales, view, K, camera.width, camera.height,
        eps2d=DILATION, near_plane=near, packed=packed, opacities=visible_opacities,
    )  # fmt: skip
    if packed:
        _, image_ids, rows, radii, means2d, depths, conics, _ = result
        rows = rows.long()
        tiles = _tile_lists(gsplat, camera, means2d, radii, depths, image_ids, rows)
        means2d = means.new_zeros(n, 2).index_put((rows,), means2d)
        depths = means.new_zeros(n).index_put((rows,), depths)
        conics = means.new_zeros(n, 3).index_put((rows,), conics)
        reach = torch.zeros(n, 2, dtype=radii.dtype, device=means.device).index_put((rows,), radii)
        seen = (reach > 0).all(-1)
    else:
        radii, means2d, depths, conics, _ = result
        tiles = _tile_lists(gsplat, camera, means2d, radii, depths)
        # Not [0], whose gradient would be a copy in zeros.
        reach, means2d, depths, conics = (t.squeeze(0) for t in (radii, means2d, depths, conics))
        # gsplat leaves what is culled unwritten.
        seen = (reach > 0).all(-1)
        means2d = torch.where(seen[:, None], means2d, 0)
        depths = torch.where(seen, depths, 0)
        conics = torch.where(seen[:, None], conics, 0)
    largest = torch.where(seen, reach.amax(-1), 0)
    return _projection(camera, means2d, depths, conics, opacities, largest, tiles, absgrad)


def _projection(
    camera: Camera,
    means2d: Tensor,
    depths: Tensor,
    conics: Tensor,
    opacities: Tensor,
    radii: Tensor,
    tiles: _Tiles | None,
    absgrad: bool,
) -> Projection:
    total = torch.zeros_like(means2d, requires_grad=False) if absgrad else None
    return Projection(camera, means2d, depths, conics, opacities, radii, "cuda", tiles, total)


def _tile_lists(
    gsplat: Any,
    camera: Camera,
    means2d: Tensor,
    radii: Tensor,
    depths: Tensor,
    image_ids: Tensor | None = None,
    rows: Tensor | None = None,
) -> _Tiles:
    columns, lines = -(-camera.width // TILE), -(-camera.height // TILE)
    packed = rows is not None
    _, intersections, flatten_ids = gsplat.isect_tiles(
        means2d, radii, depths, TILE, columns, lines,
        packed=packed, n_images=1, image_ids=image_ids, gaussian_ids=None if rows is None else rows.int(),
    )  # fmt: skip
    offsets = gsplat.isect_offset_encode(intersections, 1, columns, lines).reshape(1, lines, columns)
    return _Tiles(offsets, flatten_ids, rows)


def blend(
    projection: Projection, colors: Float[Tensor, "N C"], background: Float[Tensor, "C"] | None, depth: bool
) -> Rendering:
    """See `wildgs.rasterize.blend`."""
    camera, tiles = projection.camera, projection.tiles
    height, width, channels = camera.height, camera.width, colors.shape[1]
    if tiles is None:
        flat = colors.new_zeros(height, width)
        behind = colors.new_zeros(channels) if background is None else background
        return Rendering(behind.expand(height, width, channels), flat, flat.clone())
    # Depth is one more channel; gsplat does not blend none at all.
    values = colors
    if depth or channels == 0:
        values = torch.cat([colors, projection.depths[:, None]], dim=1)
    behind = None
    if background is not None:
        behind = torch.cat([background, background.new_zeros(values.shape[1] - channels)])[None]
    screen = [projection.means2d, projection.conics, values, projection.opacities.clamp(max=1)]
    screen = [t[None] if tiles.rows is None else t[tiles.rows] for t in screen]
    if projection.absgrad is not None and screen[0].requires_grad:
        _collect_absgrad(screen[0], projection.absgrad, tiles.rows)
    sums, alpha = _gsplat().rasterize_to_pixels(
        *screen, width, height, TILE, tiles.offsets, tiles.flatten_ids,
        backgrounds=behind, packed=tiles.rows is not None, absgrad=projection.absgrad is not None,
    )  # fmt: skip
    sums, alpha = sums.reshape(height, width, -1), alpha.reshape(height, width)
    expected = sums[..., channels] / alpha.clamp(min=_LEAST_ALPHA) if depth else torch.zeros_like(alpha)
    return Rendering(sums[..., :channels], expected, alpha)


def _collect_absgrad(centres: Tensor, total: Tensor, rows: Tensor | None) -> None:
    """Adds gsplat's absolute gradients, which its backward pass hangs on its input, to the projection's."""
    cell = [centres]  # emptied by the hook, so that centres and hook do not keep each other alive

    def collect(grad: Tensor) -> None:
        absolute = cell.pop().absgrad.reshape(-1, 2)  # type: ignore[attr-defined]
        total.add_(absolute) if rows is None else total.index_add_(0, rows, absolute)

    centres.register_hook(collect)


def sh_to_colors(
    means: Float[Tensor, "N 3"],
    sh: Float[Tensor, "N K 3"],
    camera: Camera,
    degree: int,
    visible: Bool[Tensor, "N"] | None,
) -> Float[Tensor, "N 3"]:
    """See `wildgs.rasterize.sh_to_colors`."""
    directions = means - camera.position.to(means)
    colors = (_gsplat().spherical_harmonics(degree, directions, sh, masks=visible) + 0.5).clamp(min=0)
    return colors if visible is None else torch.where(visible[:, None], colors, 0)


def selective_adam(
    parameters: Iterable[Any], *, eps: float = 1e-15, betas: tuple[float, float] = (0.9, 0.999)
) -> torch.optim.Adam:
    """Adam of gsplat that touches only the Gaussians that were seen (Taming 3DGS).

    Args:
        parameters: Groups of one CUDA tensor each, first axis over Gaussians, each with its `lr`.
        eps: As in Adam.
        betas: As in Adam.

    Returns:
        An optimiser whose `step(visibility)` takes `Projection.visible`.

    Raises:
        UserError: gsplat is not installed.
    """
    _gsplat()
    from gsplat.optimizers import SelectiveAdam

    return SelectiveAdam(parameters, eps=eps, betas=betas)
