"""The CUDA backend: gsplat 1.5 behind this package's interface. Imported only on demand."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from wildgs.geometry.camera import Camera
from wildgs.rasterize.gsplat_library import load_gsplat
from wildgs.rasterize.interface import TILE, Projection, Rendering

_LEAST_ALPHA = 1e-10


@dataclass(frozen=True)
class _Tiles:
    """gsplat's sorted tile intersections of one image.

    Attributes:
        offsets: Where each tile's list starts.
        flatten_ids: Indices of Gaussians, tile by tile, nearest first.
    """

    offsets: Tensor
    flatten_ids: Tensor


def _finite(means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor) -> tuple[Tensor, ...]:
    """Makes non-finite Gaussians transparent, so that gsplat culls them."""
    with torch.no_grad():
        # A sum is finite only if all of its terms are.
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
    eps2d: float,
    antialiased: bool,
) -> Projection:
    """See `wildgs.rasterize.project`."""
    gsplat = load_gsplat()
    if len(means) == 0:
        empty = means.new_zeros(0)
        return _projection(camera, means[:, :2], empty, means, opacities, empty.int(), None, absgrad)
    means, quats, scales, visible_opacities = _finite(means, quats, scales, opacities)
    view, K = (t.to(means)[None] for t in (camera.viewmat, camera.K))
    # Packed mode is not used: in gsplat 1.5.3 it reads Gaussian indices of another integer type than it writes.
    radii, means2d, depths, conics, compensations = gsplat.fully_fused_projection(
        means, None, quats, scales, view, K, camera.width, camera.height,
        eps2d=eps2d, near_plane=near, packed=False, opacities=visible_opacities,
        calc_compensations=antialiased,
    )  # fmt: skip
    columns, lines = -(-camera.width // TILE), -(-camera.height // TILE)
    _, intersections, flatten_ids = gsplat.isect_tiles(
        means2d, radii, depths, TILE, columns, lines, packed=False, n_images=1
    )
    offsets = gsplat.isect_offset_encode(intersections, 1, columns, lines).reshape(1, lines, columns)
    # Not [0], whose gradient would be a copy in zeros.
    reach, means2d, depths, conics = (t.squeeze(0) for t in (radii, means2d, depths, conics))
    # gsplat does not initialise the outputs of culled Gaussians.
    seen = (reach > 0).all(-1)
    means2d = torch.where(seen[:, None], means2d, 0)
    depths = torch.where(seen, depths, 0)
    conics = torch.where(seen[:, None], conics, 0)
    if antialiased:
        opacities = torch.where(seen, opacities.clamp(max=1) * compensations.squeeze(0), 0)
    largest = torch.where(seen, reach.amax(-1), 0)
    tiles = _Tiles(offsets, flatten_ids)
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


def blend_tiles(
    projection: Projection, colors: Float[Tensor, "N C"], chosen: Bool[Tensor, "R S"]
) -> Rendering:
    """Blends only the chosen tiles; gsplat does not initialise alpha in the others."""
    return blend(projection, colors, None, True, chosen[None])


def blend(
    projection: Projection,
    colors: Float[Tensor, "N C"],
    background: Float[Tensor, "C"] | None,
    depth: bool,
    chosen: Bool[Tensor, "1 R S"] | None = None,
) -> Rendering:
    """See `wildgs.rasterize.blend`; if `chosen` is given, only those tiles are blended."""
    camera, tiles = projection.camera, projection.tiles
    height, width, channels = camera.height, camera.width, colors.shape[1]
    if tiles is None:
        flat = colors.new_zeros(height, width)
        behind = colors.new_zeros(channels) if background is None else background
        return Rendering(behind.expand(height, width, channels), flat, flat.clone())
    # Depth is an extra channel; gsplat cannot blend zero channels.
    values = colors
    if depth or channels == 0:
        values = torch.cat([colors, projection.depths[:, None]], dim=1)
    screen = [projection.means2d, projection.conics, values, projection.opacities.clamp(max=1)]
    screen = [t[None] for t in screen]
    if projection.absgrad is not None and screen[0].requires_grad:
        _collect_absgrad(screen[0], projection.absgrad)
    sums, alpha = load_gsplat().rasterize_to_pixels(
        *screen, width, height, TILE, tiles.offsets, tiles.flatten_ids,
        masks=chosen, packed=False, absgrad=projection.absgrad is not None,
    )  # fmt: skip
    sums, alpha = sums.reshape(height, width, -1), alpha.reshape(height, width)
    expected = sums[..., channels] / alpha.clamp(min=_LEAST_ALPHA) if depth else torch.zeros_like(alpha)
    painted = sums[..., :channels]
    if background is not None:
        painted = painted + (1 - alpha)[..., None] * background
    return Rendering(painted, expected, alpha)


def _collect_absgrad(centres: Tensor, total: Tensor) -> None:
    """Adds the absolute gradients, which gsplat's backward pass attaches to its input, to the projection's."""
    cell = [centres]  # emptied by the hook to break the reference cycle between the tensor and its hook

    def collect(grad: Tensor) -> None:
        total.add_(cell.pop().absgrad.reshape(-1, 2))  # type: ignore[attr-defined]

    centres.register_hook(collect)


def sh_to_colors(
    means: Float[Tensor, "N 3"],
    sh: Float[Tensor, "N K 3"],
    camera: Camera,
    degree: int,
    visible: Bool[Tensor, "N"] | None,
    clamped: bool,
) -> Float[Tensor, "N 3"]:
    """See `wildgs.rasterize.sh_to_colors`."""
    directions = means - camera.position.to(means)
    colors = load_gsplat().spherical_harmonics(degree, directions, sh, masks=visible) + 0.5
    if clamped:
        colors = colors.clamp(min=0)
    return colors if visible is None else torch.where(visible[:, None], colors, 0)
