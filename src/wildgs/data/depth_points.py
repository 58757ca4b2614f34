"""Points where structure from motion found none: from the photos' depth priors, brought to the scene's scale.

Paving, lawns and bare walls have no features that SIFT could match between photos of different light, so no
Gaussian starts there; a monocular network sees them all the same. Each photo's disparity is fitted to the SfM
points that the photo sees, and only what several photos agree on is kept, so that passers-by are left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from wildgs.data.scene import Scene, View
from wildgs.geometry.camera import Camera

MAX_PHOTOS = 200
"""Photos that are asked; of larger scenes evenly many over the list."""

_HYPOTHESES = 256
_TOLERANCE = 0.05
_MIN_POINTS, _MIN_INLIERS = 24, 0.4
_MIN_CORRELATION = 0.7  # where all is about as far, a constant fits, and says nothing of what lies between


@dataclass(frozen=True)
class DepthPointsConfig:
    """Initial points from depth priors; scenes without depth priors have none.

    Attributes:
        points: At most so many; 0 starts from SfM points alone, as the paper does.
        cell: Side of the cells in which photos have to agree, in units of the aligned frame (photos' median depth).
        support: Photos that have to see a surface in a cell.
        agreement: Of the photos that look at a cell, least share that see the surface there and not beyond.
        farthest: Nothing further from a camera than this, in units of the aligned frame.
    """

    points: int = 20_000
    cell: float = 0.02
    support: int = 3
    agreement: float = 0.3
    farthest: float = 4.0


@dataclass(frozen=True)
class _Depth:
    """A photo's disparity as depth in the scene's scale; 0 where it says nothing."""

    view: View
    depth: Float[Tensor, "H W"]


def depth_points(
    scene: Scene, config: DepthPointsConfig, seed: int = 0
) -> tuple[Float[Tensor, "P 3"], UInt8[Tensor, "P 3"]]:
    """Points of surfaces that several training photos see and SfM has no point of.

    Args:
        scene: With depth priors; photos without one, or whose disparity does not fit the points, are passed over.
        config: What counts as agreement.
        seed: Of the choice among too many points.

    Returns:
        Positions in the aligned frame, and colours (the mean over photos). Empty where nothing is to be had.
    """
    nothing = torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.uint8)
    if config.points == 0:
        return nothing
    generator = torch.Generator().manual_seed(seed)
    depths = [
        depth for view in _evenly(scene.train_views) if (depth := _fitted(view, scene.points, generator))
    ]
    if not depths:
        return nothing
    samples = [_samples(each, config) for each in depths]
    points = torch.cat([each for each, _ in samples])
    colors = torch.cat([each for _, each in samples])
    photos = torch.cat([torch.full((len(each),), index) for index, (each, _) in enumerate(samples)])
    means, means_of_color, support = _by_cell(points, colors, photos, config.cell)
    kept = (support >= config.support) & ~_near(means, scene.points, config.cell)
    means, means_of_color, support = means[kept], means_of_color[kept], support[kept]
    kept = support >= config.agreement * (support + _seen_through(means, depths, config.cell))
    means, means_of_color = means[kept], means_of_color[kept]
    if len(means) > config.points:
        chosen = torch.randperm(len(means), generator=generator)[: config.points].sort().values
        means, means_of_color = means[chosen], means_of_color[chosen]
    return means, means_of_color.round().clamp(0, 255).to(torch.uint8)


def _evenly(views: Sequence[View]) -> list[View]:
    if len(views) <= MAX_PHOTOS:
        return list(views)
    return [views[round(index)] for index in torch.linspace(0, len(views) - 1, MAX_PHOTOS).tolist()]


def _project(points: Float[Tensor, "P 3"], camera: Camera) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Column and row (always within the picture) and depth of every point, and whether the picture has it."""
    seen = points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    z = seen[:, 2]
    pixels = seen @ camera.K.T
    x, y = (pixels[:, 0] / z.clamp_min(1e-6)).floor(), (pixels[:, 1] / z.clamp_min(1e-6)).floor()
    inside = (z > 1e-3) & (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height)
    return x.clamp(0, camera.width - 1).long(), y.clamp(0, camera.height - 1).long(), z, inside


def _fitted(view: View, points: Float[Tensor, "P 3"], generator: torch.Generator) -> _Depth | None:
    """The photo's depth in the scene's scale, or None where it has no disparity that fits the points."""
    disparity = view.read_disparity()
    if disparity is None:
        return None
    x, y, z, inside = _project(points, view.camera)
    sampled = disparity[y, x]
    inside = inside & (sampled > 0)
    fit = fit_disparity(sampled[inside], 1 / z[inside], generator)
    if fit is None:
        return None
    inverse = fit[0] * disparity + fit[1]
    # Beyond the farthest point that was fitted, a small error of the disparity is a large one of depth.
    reliable = (disparity > 0) & (inverse > (1 / z[inside]).quantile(0.02))
    return _Depth(view, torch.where(reliable, 1 / inverse.clamp_min(1e-6), 0.0))


def fit_disparity(
    disparity: Float[Tensor, " P"], inverse_depth: Float[Tensor, " P"], generator: torch.Generator
) -> tuple[float, float] | None:
    """Scale and shift with which disparity is inverse depth, for the most points (RANSAC, then least squares).

    Points behind what the photo shows, and passers-by before them, do not fit.

    Returns:
        (scale, shift), or None where too few points fit, or disparity does not grow with nearness.
    """
    count = len(disparity)
    if count < _MIN_POINTS:
        return None
    pairs = torch.randint(count, (2, _HYPOTHESES), generator=generator)
    run = disparity[pairs[0]] - disparity[pairs[1]]
    scale = (inverse_depth[pairs[0]] - inverse_depth[pairs[1]]) / torch.where(run.abs() > 1e-9, run, 1e-9)
    shift = inverse_depth[pairs[0]] - scale * disparity[pairs[0]]
    fits = _fits(disparity, inverse_depth, scale[:, None], shift[:, None]) & (scale[:, None] > 0)
    best = fits[int(fits.sum(dim=1).argmax())]
    for _ in range(2):
        if float(best.float().mean()) < _MIN_INLIERS:
            return None
        rows = torch.stack([disparity[best], torch.ones(int(best.sum()))], dim=1).double()
        weights = 1 / inverse_depth[best].double()[:, None]  # relative errors count
        solved = torch.linalg.lstsq(rows * weights, torch.ones_like(weights)).solution[:, 0]
        slope, offset = float(solved[0]), float(solved[1])
        best = _fits(disparity, inverse_depth, slope, offset)
    together = torch.corrcoef(torch.stack([disparity[best], inverse_depth[best]]))[0, 1]
    return (slope, offset) if slope > 0 and float(together) > _MIN_CORRELATION else None


def _fits(disparity: Tensor, inverse_depth: Tensor, scale: Tensor | float, shift: Tensor | float) -> Tensor:
    return (scale * disparity + shift - inverse_depth).abs() < _TOLERANCE * inverse_depth


def _samples(found: _Depth, config: DepthPointsConfig) -> tuple[Float[Tensor, "S 3"], Float[Tensor, "S 3"]]:
    """Points and colours of a photo's pixels, about two to a cell's side at the median depth."""
    view = found.view
    step = max(1, int(0.5 * config.cell * float(view.camera.K[0, 0])))
    keep = (found.depth > 0) & (found.depth < config.farthest)
    mask = view.read_mask()
    if mask is not None:
        keep = keep & (mask > 0)
    keep, grid = keep[::step, ::step], view.camera.unproject(found.depth)[::step, ::step]
    return grid[keep], view.read_photo()[::step, ::step][keep].float()


def _cells(points: Float[Tensor, "P 3"], cell: float) -> Int[Tensor, " P"]:
    """A number for the cell of every point (the grid spans a million cells a side)."""
    index = (points / cell).floor().long().clamp(-(2**19), 2**19 - 1) + 2**19
    return (index[:, 0] << 40) | (index[:, 1] << 20) | index[:, 2]


def _by_cell(
    points: Float[Tensor, "P 3"], colors: Float[Tensor, "P 3"], photos: Int[Tensor, " P"], cell: float
) -> tuple[Float[Tensor, "C 3"], Float[Tensor, "C 3"], Int[Tensor, " C"]]:
    """Mean place and colour of each cell's points, and how many photos they are from."""
    keys, member = torch.unique(_cells(points, cell), return_inverse=True)
    number = torch.zeros(len(keys)).index_add_(0, member, torch.ones(len(points)))[:, None]
    places = torch.zeros(len(keys), 3).index_add_(0, member, points) / number
    means = torch.zeros(len(keys), 3).index_add_(0, member, colors) / number
    pairs = torch.unique(torch.stack([member, photos]), dim=1)
    return places, means, torch.bincount(pairs[0], minlength=len(keys))


def _near(points: Float[Tensor, "P 3"], others: Float[Tensor, "Q 3"], cell: float) -> Bool[Tensor, " P"]:
    """Whether a point shares its cell with one of the others."""
    return torch.isin(_cells(points, cell), _cells(others, cell))


def _seen_through(points: Float[Tensor, "P 3"], depths: Sequence[_Depth], cell: float) -> Int[Tensor, " P"]:
    """How many photos see something clearly beyond each point."""
    through = torch.zeros(len(points), dtype=torch.int64)
    for each in depths:
        x, y, z, inside = _project(points, each.view.camera)
        through += inside & (each.depth[y, x] > (1 + 2 * _TOLERANCE) * z + cell)
    return through
