"""Reference rasteriser in dense PyTorch: slow, differentiable by autograd, in float32 or float64.

The other backends are tested against it. Semantics are those of gsplat 1.5's modes classic and antialiased, see
`interface`.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from wildgs.geometry.camera import Camera, quats_to_rotations
from wildgs.geometry.spherical_harmonics import num_sh_bases, sh_basis
from wildgs.rasterize.interface import (
    MAX_ALPHA,
    MIN_ALPHA,
    MIN_TRANSMITTANCE,
    Projection,
    Rendering,
)

_ELEMENTS = 1 << 22  # (Gaussian, pixel) pairs in memory at once


def _jacobian(points: Float[Tensor, "N 3"], K: Float[Tensor, "3 3"], width: int, height: int) -> Tensor:
    """Jacobian of the perspective projection; points are clamped to the image plus a margin of 15% of its size."""
    x, y, z = points.unbind(-1)
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    margin_x, margin_y = 0.15 * width / fx, 0.15 * height / fy
    tx = (x / z).clamp(float(-cx / fx - margin_x), float((width - cx) / fx + margin_x))
    ty = (y / z).clamp(float(-cy / fy - margin_y), float((height - cy) / fy + margin_y))
    zero = torch.zeros_like(z)
    return torch.stack(
        [torch.stack([fx / z, zero, -fx * tx / z], -1), torch.stack([zero, fy / z, -fy * ty / z], -1)], dim=-2
    )


def _valid(means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor) -> Tensor:
    """Mask of Gaussians that are finite and not transparent; others would propagate NaN to the gradients."""
    finite = means.isfinite().all(-1) & quats.isfinite().all(-1) & scales.isfinite().all(-1)
    return finite & opacities.isfinite() & (opacities >= MIN_ALPHA)


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
    viewmat, K = camera.viewmat.to(means), camera.K.to(means)
    with torch.no_grad():
        points = means @ viewmat[:3, :3].T + viewmat[:3, 3]
        chosen = (_valid(means, quats, scales, opacities) & (points[:, 2] > near)).nonzero()[:, 0]
    points = means[chosen] @ viewmat[:3, :3].T + viewmat[:3, 3]
    spread = viewmat[:3, :3] @ quats_to_rotations(quats[chosen]) * scales[chosen, None, :]
    footprint = _jacobian(points, K, camera.width, camera.height) @ spread
    covariance = footprint @ footprint.mT + eps2d * torch.eye(2).to(means)
    a, b, c = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    determinant = a * c - b * b
    centres = points[:, :2] / points[:, 2:] * K.diagonal()[:2] + K[:2, 2]
    conics = torch.stack([c, -b, a], -1) / determinant[:, None]
    opacities = opacities.clamp(max=1)
    if antialiased:
        before = torch.linalg.cross(footprint[:, 0], footprint[:, 1]).square().sum(-1)
        compensation = (before / determinant).clamp(1e-20, 1).sqrt()
        opacities = torch.zeros_like(opacities).index_put((chosen,), opacities[chosen] * compensation)

    with torch.no_grad():
        extent = (2 * (opacities[chosen] / MIN_ALPHA).log()).clamp(min=0).sqrt()
        half = extent[:, None] * torch.stack([a, c], -1).sqrt()
        size = torch.tensor([camera.width, camera.height]).to(half)
        inside = ((centres + half > 0) & (centres - half < size)).all(-1)
        numbers = torch.cat([centres, conics, covariance.flatten(1)], -1)
        kept = inside & (opacities[chosen] >= MIN_ALPHA) & (determinant > 0) & numbers.isfinite().all(-1)
        radii = torch.zeros(len(means), dtype=torch.int32, device=means.device)
        radii[chosen[kept]] = half.amax(-1).ceil().clamp(max=1e9).to(torch.int32)[kept]
    index = chosen[kept]
    return Projection(
        camera=camera,
        means2d=means.new_zeros(len(means), 2).index_put((index,), centres[kept]),
        depths=means.new_zeros(len(means)).index_put((index,), points[kept, 2]),
        conics=means.new_zeros(len(means), 3).index_put((index,), conics[kept]),
        opacities=opacities,
        radii=radii,
        backend="reference",
        tiles=None,
        absgrad=torch.zeros_like(means[:, :2]) if absgrad else None,
    )


def blend(
    projection: Projection, colors: Float[Tensor, "N C"], background: Float[Tensor, "C"] | None, depth: bool
) -> Rendering:
    """See `wildgs.rasterize.blend`."""
    camera = projection.camera
    order = projection.visible.nonzero()[:, 0]
    order = order[projection.depths.detach()[order].argsort(stable=True)]
    rows = torch.arange(camera.height * camera.width, device=colors.device)
    pixels = torch.stack([rows % camera.width, rows // camera.width], -1).to(projection.means2d) + 0.5
    step = max(1, _ELEMENTS // max(1, len(order)))
    values = torch.cat([colors, projection.depths[:, None]], -1)[order]
    parts = [
        _blend_pixels(projection, order, values, pixels[i : i + step]) for i in range(0, len(pixels), step)
    ]
    sums = torch.cat([part[0] for part in parts])
    alpha = torch.cat([part[1] for part in parts])
    pictures = sums[:, :-1]
    if background is not None:
        pictures = pictures + (1 - alpha)[:, None] * background
    seen = alpha > 0
    expected = torch.where(seen, sums[:, -1] / torch.where(seen, alpha, 1), 0)
    shape = (camera.height, camera.width)
    return Rendering(
        colors=pictures.reshape(*shape, -1) if pictures.shape[1] else pictures.new_zeros(*shape, 0),
        depth=expected.reshape(shape) if depth else expected.new_zeros(()).expand(shape),
        alpha=alpha.reshape(shape),
    )


def blend_tiles(
    projection: Projection, colors: Float[Tensor, "N C"], chosen: Bool[Tensor, "R S"]
) -> Rendering:
    """Blends all tiles, which include the chosen ones."""
    return blend(projection, colors, None, True)


def _blend_pixels(
    projection: Projection, order: Tensor, values: Tensor, pixels: Tensor
) -> tuple[Tensor, Tensor]:
    """Alpha-weighted sums of the values at some pixels, and the accumulated alpha."""
    centres = projection.means2d[order, None].expand(-1, len(pixels), -1)
    if projection.absgrad is not None and centres.requires_grad:
        total = projection.absgrad

        def add_absolute(grad: Tensor) -> None:
            total.index_add_(0, order, grad.abs().sum(1))

        centres.register_hook(add_absolute)
    dx, dy = (pixels - centres).unbind(-1)
    a, b, c = projection.conics[order, None].unbind(-1)
    falloff = torch.exp(-(0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy))
    alpha = (projection.opacities[order, None] * falloff).clamp(max=MAX_ALPHA)
    alpha = torch.where(alpha >= MIN_ALPHA, alpha, 0)
    after = torch.cumprod(1 - alpha, dim=0)
    # The first Gaussian that would leave too little transmittance and all Gaussians behind it are skipped.
    alpha = torch.where(after > MIN_TRANSMITTANCE, alpha, 0)
    after = torch.cumprod(1 - alpha, dim=0)
    before = torch.cat([torch.ones_like(after[:1]), after[:-1]]) if len(order) else after
    weights = alpha * before
    return weights.mT @ values, weights.sum(0)


def sh_to_colors(
    means: Float[Tensor, "N 3"],
    sh: Float[Tensor, "N K 3"],
    camera: Camera,
    degree: int,
    visible: Tensor | None,
    clamped: bool,
) -> Float[Tensor, "N 3"]:
    """See `wildgs.rasterize.sh_to_colors`."""
    bases = sh_basis(degree, normalize(means - camera.position.to(means), dim=-1))
    colors = torch.einsum("nk,nkc->nc", bases, sh[:, : num_sh_bases(degree)]) + 0.5
    if clamped:
        colors = colors.clamp(min=0)
    return colors if visible is None else torch.where(visible[:, None], colors, 0)
