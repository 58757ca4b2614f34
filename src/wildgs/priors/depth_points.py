"""Initial points from metric depth and depth priors, for surfaces on which SfM found no points.

Paving, lawns and bare walls have no features that SIFT can match between photos in different lighting, so no
Gaussians are initialised there; a monocular depth network covers them nevertheless. The disparity of each photo is
aligned to the SfM points visible in it. Only points on which several photos agree are kept, which excludes
passers-by.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import reduce

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from wildgs.geometry.camera import Camera
from wildgs.priors.config import DepthPointsConfig
from wildgs.scene.scene import Scene, View, observed_rows

MAX_PHOTOS = 200
"""Maximum number of photos that are used; larger scenes are subsampled evenly."""

METRIC_VOTES = 2
"""Votes of a photo with metric depth, which several photos already agreed on; a depth prior has one.

With `support` of 3, two such photos make a point. One is not enough: in real collections, a third of the estimates
of stereo are more than 5% wrong.
"""
METRIC_CELL = 0.5
"""Side of the voting cells of metric depth, relative to those of depth priors."""
_HYPOTHESES = 256
_TOLERANCE = 0.05
_MIN_POINTS, _MIN_INLIERS = 24, 0.4
_MAX_POINTS = 20_000  # per photo; more do not improve the fit, and memory is 256 times as many numbers
_MIN_CORRELATION = 0.7  # at nearly constant depth, a constant fits too, but does not determine the scale


@dataclass(frozen=True)
class _PhotoDepth:
    """Depth of one photo: the pixels with depth as points, and a depth map of every `step`-th pixel (0 = none)."""

    points: Float[Tensor, "S 3"]
    colors: Float[Tensor, "S 3"]
    camera: Camera
    depth: Float[Tensor, "h w"]
    step: int
    votes: int


def depth_points(
    scene: Scene, config: DepthPointsConfig, seed: int = 0
) -> tuple[Float[Tensor, "P 3"], UInt8[Tensor, "P 3"]]:
    """Computes points of surfaces that several training photos show but that have no SfM points.

    Args:
        scene: A scene with depth priors; photos without one, or whose disparity cannot be aligned, are skipped.
        config: Thresholds of agreement.
        seed: Seed of the random subset if there are more than `config.points` points.

    Returns:
        Positions in the aligned frame, and colours (mean over photos). Empty if no depth is available.
    """
    empty = torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.uint8)
    if config.points == 0:
        return empty
    generator = torch.Generator().manual_seed(seed)
    views = _subsample(scene.train_views)
    photos = [photo for view in views for photo in _photo_depths(scene, view, config, generator)]
    existing, parts = scene.points, [empty]
    for votes, cell in ((METRIC_VOTES, METRIC_CELL * config.cell), (1, config.cell)):
        sources = [photo for photo in photos if photo.votes == votes]
        if sources:
            parts.append(_agreed_points(sources, photos, existing, cell, config))
            existing = torch.cat([existing, parts[-1][0]])
    means, colors = (torch.cat(both) for both in zip(*parts, strict=True))
    if len(means) > config.points:
        chosen = torch.randperm(len(means), generator=generator)[: config.points].sort().values
        means, colors = means[chosen], colors[chosen]
    return means, colors


def _agreed_points(
    sources: Sequence[_PhotoDepth],
    photos: Sequence[_PhotoDepth],
    existing: Float[Tensor, "K 3"],
    cell: float,
    config: DepthPointsConfig,
) -> tuple[Float[Tensor, "P 3"], UInt8[Tensor, "P 3"]]:
    """One point per cell of the sources' points, where enough of them agree and no point exists yet."""
    points, colors = (
        torch.cat([seen.points for seen in sources]),
        torch.cat([seen.colors for seen in sources]),
    )
    indices = torch.cat([torch.full((len(seen.points),), index) for index, seen in enumerate(sources)])
    votes = torch.tensor([seen.votes for seen in sources])
    means, mean_colors, support = _average_cells(points, colors, indices, votes, cell)
    kept = (support >= config.support) & ~_share_cell(means, existing, cell)
    means, mean_colors, support = means[kept], mean_colors[kept], support[kept]
    kept = support >= config.agreement * (support + _contradictions(means, photos, config.cell))
    return means[kept], mean_colors[kept].round().clamp(0, 255).to(torch.uint8)


def _subsample(views: Sequence[View]) -> list[View]:
    if len(views) <= MAX_PHOTOS:
        return list(views)
    return [views[round(index)] for index in torch.linspace(0, len(views) - 1, MAX_PHOTOS).tolist()]


def sample_at(
    points: Float[Tensor, "P 3"], camera: Camera, picture: Float[Tensor, "h w"], step: int = 1
) -> tuple[Float[Tensor, " P"], Float[Tensor, " P"]]:
    """Depth of each point, and the value of an image (of every `step`-th pixel) at its pixel; 0 outside."""
    pixels, z = camera.project(points)
    size = torch.tensor([camera.width, camera.height])
    inside = (z > 1e-3) & ((pixels >= 0) & (pixels < size)).all(dim=1)
    x, y = torch.where(inside[:, None], pixels, 0.0).long().div(step, rounding_mode="floor").unbind(dim=1)
    return z, torch.where(inside, picture[y, x], 0.0)


def _photo_depths(
    scene: Scene, view: View, config: DepthPointsConfig, generator: torch.Generator
) -> Iterator[_PhotoDepth]:
    """Depth of a photo in the scene's scale: metric depth, and aligned disparity where metric depth is missing."""
    metric, aligned = aligned_depth(scene, view, generator)
    if metric is not None:
        yield _to_points(view, metric, METRIC_VOTES, config)
    if aligned is not None:
        yield _to_points(view, aligned, 1, config)


def aligned_depth(
    scene: Scene, view: View, generator: torch.Generator
) -> tuple[Float[Tensor, "H W"] | None, Float[Tensor, "H W"] | None]:
    """Reads the depth maps of a photo.

    Disparity is aligned to the points that the photo observes or, if that fails, to all that project into it, some
    of which are hidden by passers-by or on the other side of the building.

    Args:
        scene: The scene, with its sparse points.
        view: The photo.
        generator: Random numbers for the fit.

    Returns:
        Metric depth, and disparity converted to depth where metric depth is missing, both in world units along the
        camera's z axis and 0 where unknown; None for a map that does not exist or cannot be aligned.
    """
    metric, disparity, aligned = view.read_depth(), view.read_disparity(), None
    if disparity is not None:
        for points in (scene.points[observed_rows(scene, view)], scene.points):
            if aligned is None:
                aligned = _align(view.camera, disparity, metric, points, generator)
    if aligned is not None and metric is not None:
        aligned = torch.where(metric > 0, 0.0, aligned)
    return metric, aligned


def known_depth(maps: Iterable[Float[Tensor, "H W"] | None]) -> Bool[Tensor, "H W"] | None:
    """Pixels of which at least one depth map of a photo tells the depth; None without maps.

    Args:
        maps: From `aligned_depth`.
    """
    known = [depth > 0 for depth in maps if depth is not None]
    return reduce(torch.logical_or, known) if known else None


def _align(
    camera: Camera,
    disparity: Float[Tensor, "H W"],
    metric: Float[Tensor, "H W"] | None,
    points: Float[Tensor, "P 3"],
    generator: torch.Generator,
) -> Float[Tensor, "H W"] | None:
    """Converts disparity to depth by a fit to the photo's points and metric depth; None if the fit fails."""
    z, sampled = sample_at(points, camera, disparity)
    z, sampled = z[sampled > 0], sampled[sampled > 0]
    if metric is not None:
        both = (metric > 0) & (disparity > 0)
        z, sampled = torch.cat([z, metric[both]]), torch.cat([sampled, disparity[both]])
    fit = fit_disparity(sampled, 1 / z, generator)
    if fit is None:
        return None
    inverse = fit[0] * disparity + fit[1]
    # Beyond the farthest fitted points, a small error of the disparity causes a large error of the depth.
    reliable = (disparity > 0) & (inverse * z.sort().values[int(0.98 * (len(z) - 1))] > 1)
    return torch.where(reliable, 1 / inverse.clamp_min(1e-6), 0.0)


def _to_points(view: View, depth: Float[Tensor, "H W"], votes: int, config: DepthPointsConfig) -> _PhotoDepth:
    # Two samples per side of a cell at the median depth, which is 1.
    cell = METRIC_CELL * config.cell if votes == METRIC_VOTES else config.cell
    step = max(1, int(0.5 * cell * float(view.camera.K[0, 0])))
    keep = (depth > 0) & (depth < config.farthest)
    mask = view.read_mask()
    if mask is not None:
        keep = keep & (mask > 0)
    keep, points = keep[::step, ::step], view.camera.unproject(depth)[::step, ::step]
    colors = view.read_photo()[::step, ::step][keep].float()
    return _PhotoDepth(points[keep], colors, view.camera, depth[::step, ::step].contiguous(), step, votes)


def fit_disparity(
    disparity: Float[Tensor, " P"], inverse_depth: Float[Tensor, " P"], generator: torch.Generator
) -> tuple[float, float] | None:
    """Fits the scale and shift from disparity to inverse depth (RANSAC, then least squares on the inliers).

    Outliers are points occluded in the photo, for example by passers-by.

    Returns:
        (scale, shift); None if there are too few inliers or disparity does not increase with inverse depth.
    """
    count = len(disparity)
    if count < _MIN_POINTS:
        return None
    if count > _MAX_POINTS:
        subset = torch.randperm(count, generator=generator)[:_MAX_POINTS]
        disparity, inverse_depth, count = disparity[subset], inverse_depth[subset], _MAX_POINTS
    pairs = torch.randint(count, (2, _HYPOTHESES), generator=generator)
    difference = disparity[pairs[0]] - disparity[pairs[1]]
    difference = torch.where(difference.abs() > 1e-9, difference, 1e-9)
    scale = (inverse_depth[pairs[0]] - inverse_depth[pairs[1]]) / difference
    shift = inverse_depth[pairs[0]] - scale * disparity[pairs[0]]
    inliers = _inliers(disparity, inverse_depth, scale[:, None], shift[:, None]) & (scale[:, None] > 0)
    best = inliers[int(inliers.sum(dim=1).argmax())]
    for _ in range(2):
        if float(best.float().mean()) < _MIN_INLIERS:
            return None
        rows = torch.stack([disparity[best], torch.ones(int(best.sum()))], dim=1).double()
        weights = 1 / inverse_depth[best].double()[:, None]  # minimises relative errors
        solution = torch.linalg.lstsq(rows * weights, torch.ones_like(weights)).solution[:, 0]
        slope, offset = float(solution[0]), float(solution[1])
        best = _inliers(disparity, inverse_depth, slope, offset)
    if int(best.sum()) < _MIN_POINTS // 2:
        return None
    correlation = torch.corrcoef(torch.stack([disparity[best], inverse_depth[best]]))[0, 1]
    return (slope, offset) if slope > 0 and float(correlation) > _MIN_CORRELATION else None


def _inliers(
    disparity: Tensor, inverse_depth: Tensor, scale: Tensor | float, shift: Tensor | float
) -> Tensor:
    return (scale * disparity + shift - inverse_depth).abs() < _TOLERANCE * inverse_depth


def _cells(points: Float[Tensor, "P 3"], cell: float) -> Int[Tensor, " P"]:
    """Integer key of the cell of every point (the grid has about a million cells per axis)."""
    index = (points / cell).floor().long().clamp(-(2**19), 2**19 - 1) + 2**19
    return (index[:, 0] << 40) | (index[:, 1] << 20) | index[:, 2]


def _average_cells(
    points: Float[Tensor, "P 3"],
    colors: Float[Tensor, "P 3"],
    photos: Int[Tensor, " P"],
    votes: Int[Tensor, " S"],
    cell: float,
) -> tuple[Float[Tensor, "C 3"], Float[Tensor, "C 3"], Int[Tensor, " C"]]:
    """Mean position and colour of the points of each cell, and the votes of their photos."""
    keys, member = torch.unique(_cells(points, cell), return_inverse=True)
    count = torch.zeros(len(keys)).index_add_(0, member, torch.ones(len(points)))[:, None]
    positions = torch.zeros(len(keys), 3).index_add_(0, member, points) / count
    means = torch.zeros(len(keys), 3).index_add_(0, member, colors) / count
    # As single numbers, which torch sorts faster than pairs.
    pairs = torch.unique(member * len(votes) + photos)
    cells, photos = pairs // len(votes), pairs % len(votes)
    support = torch.zeros(len(keys), dtype=torch.int64).index_add_(0, cells, votes[photos])
    return positions, means, support


def _share_cell(
    points: Float[Tensor, "P 3"], others: Float[Tensor, "Q 3"], cell: float
) -> Bool[Tensor, " P"]:
    """Whether each point shares its cell with one of the others."""
    return torch.isin(_cells(points, cell), _cells(others, cell))


def _contradictions(
    points: Float[Tensor, "P 3"], photos: Sequence[_PhotoDepth], cell: float
) -> Int[Tensor, " P"]:
    """Number of photos whose depth at each point lies clearly behind it."""
    count = torch.zeros(len(points), dtype=torch.int64)
    for photo in photos:
        z, depth = sample_at(points, photo.camera, photo.depth, photo.step)
        count += depth > (1 + 2 * _TOLERANCE) * z + cell
    return count
