"""Points where structure from motion found none: from metric depth and from depth priors, brought to its scale.

Paving, lawns and bare walls have no features that SIFT could match between photos of different light, so no
Gaussian starts there; a monocular network sees them all the same. Each photo's disparity is fitted to the SfM
points that the photo sees, and only what several photos agree on is kept, so that passers-by are left out.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from wildgs.geometry.camera import Camera
from wildgs.priors.config import DepthPointsConfig
from wildgs.scene.scene import Scene, View

MAX_PHOTOS = 200
"""Photos that are asked; of larger scenes evenly many over the list."""

METRIC_VOTES = 3
METRIC_CELL = 0.5
"""Side of the cells of metric depth, as a share of those in which depth priors have to agree."""
_HYPOTHESES = 256
_TOLERANCE = 0.05
_MIN_POINTS, _MIN_INLIERS = 24, 0.4
_MAX_POINTS = 20_000  # of a photo; more make no better fit and a table of 256 times as many numbers
_MIN_CORRELATION = 0.7  # where all is about as far, a constant fits, and says nothing of what lies between


@dataclass(frozen=True)
class _Seen:
    """What one photo says: some of its pixels as points, and its depth at every `step`-th pixel, 0 for nothing.

    Metric depth has `METRIC_VOTES`: photos agreed on it already.
    """

    points: Float[Tensor, "S 3"]
    colors: Float[Tensor, "S 3"]
    camera: Camera
    depth: Float[Tensor, "h w"]
    step: int
    votes: int


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
    views = _evenly(scene.train_views)
    photos = [seen for view in views for seen in _look(view, scene.points, config, generator)]
    known, parts = scene.points, [nothing]
    for votes, cell in ((METRIC_VOTES, METRIC_CELL * config.cell), (1, config.cell)):
        asked = [seen for seen in photos if seen.votes == votes]
        if asked:
            parts.append(_agreed(asked, photos, known, cell, config))
            known = torch.cat([known, parts[-1][0]])
    means, colors = (torch.cat(both) for both in zip(*parts, strict=True))
    if len(means) > config.points:
        chosen = torch.randperm(len(means), generator=generator)[: config.points].sort().values
        means, colors = means[chosen], colors[chosen]
    return means, colors


def _agreed(
    asked: Sequence[_Seen],
    photos: Sequence[_Seen],
    known: Float[Tensor, "K 3"],
    cell: float,
    config: DepthPointsConfig,
) -> tuple[Float[Tensor, "P 3"], UInt8[Tensor, "P 3"]]:
    """A point for each cell of what some photos see, where enough photos agree and no point is known."""
    points, colors = torch.cat([seen.points for seen in asked]), torch.cat([seen.colors for seen in asked])
    sources = torch.cat([torch.full((len(seen.points),), index) for index, seen in enumerate(asked)])
    votes = torch.tensor([seen.votes for seen in asked])
    means, means_of_color, support = _by_cell(points, colors, sources, votes, cell)
    kept = (support >= config.support) & ~_near(means, known, cell)
    means, means_of_color, support = means[kept], means_of_color[kept], support[kept]
    kept = support >= config.agreement * (support + _seen_through(means, photos, config.cell))
    return means[kept], means_of_color[kept].round().clamp(0, 255).to(torch.uint8)


def _evenly(views: Sequence[View]) -> list[View]:
    if len(views) <= MAX_PHOTOS:
        return list(views)
    return [views[round(index)] for index in torch.linspace(0, len(views) - 1, MAX_PHOTOS).tolist()]


def _looked_up(
    points: Float[Tensor, "P 3"], camera: Camera, picture: Float[Tensor, "h w"], step: int = 1
) -> tuple[Float[Tensor, " P"], Float[Tensor, " P"]]:
    """Depth of every point, and what a picture (of every `step`-th pixel) has there: 0 for points outside it."""
    pixels, z = camera.project(points)
    size = torch.tensor([camera.width, camera.height])
    inside = (z > 1e-3) & ((pixels >= 0) & (pixels < size)).all(dim=1)
    x, y = torch.where(inside[:, None], pixels, 0.0).long().div(step, rounding_mode="floor").unbind(dim=1)
    return z, torch.where(inside, picture[y, x], 0.0)


def _look(
    view: View, points: Float[Tensor, "P 3"], config: DepthPointsConfig, generator: torch.Generator
) -> Iterator[_Seen]:
    """What a photo says in the scene's scale: by metric depth, and by its disparity where that knows nothing."""
    metric, disparity = view.read_depth(), view.read_disparity()
    if metric is not None:
        yield _sampled(view, metric, METRIC_VOTES, config)
    if disparity is None:
        return
    fitted = _scaled(view.camera, disparity, metric, points, generator)
    if fitted is not None:
        yield _sampled(view, fitted if metric is None else torch.where(metric > 0, 0.0, fitted), 1, config)


def _scaled(
    camera: Camera,
    disparity: Float[Tensor, "H W"],
    metric: Float[Tensor, "H W"] | None,
    points: Float[Tensor, "P 3"],
    generator: torch.Generator,
) -> Float[Tensor, "H W"] | None:
    """A disparity as depth, by the points and the metric depth of its photo; None where it fits neither."""
    z, sampled = _looked_up(points, camera, disparity)
    z, sampled = z[sampled > 0], sampled[sampled > 0]
    if metric is not None:
        both = (metric > 0) & (disparity > 0)
        z, sampled = torch.cat([z, metric[both]]), torch.cat([sampled, disparity[both]])
    fit = fit_disparity(sampled, 1 / z, generator)
    if fit is None:
        return None
    inverse = fit[0] * disparity + fit[1]
    # Beyond the farthest points that were fitted, a small error of the disparity is a large one of depth.
    reliable = (disparity > 0) & (inverse * z.sort().values[int(0.98 * (len(z) - 1))] > 1)
    return torch.where(reliable, 1 / inverse.clamp_min(1e-6), 0.0)


def _sampled(view: View, depth: Float[Tensor, "H W"], votes: int, config: DepthPointsConfig) -> _Seen:
    # Two to a cell's side at the usual depth.
    cell = METRIC_CELL * config.cell if votes == METRIC_VOTES else config.cell
    step = max(1, int(0.5 * cell * float(view.camera.K[0, 0])))
    keep = (depth > 0) & (depth < config.farthest)
    mask = view.read_mask()
    if mask is not None:
        keep = keep & (mask > 0)
    keep, places = keep[::step, ::step], view.camera.unproject(depth)[::step, ::step]
    colors = view.read_photo()[::step, ::step][keep].float()
    return _Seen(places[keep], colors, view.camera, depth[::step, ::step].contiguous(), step, votes)


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
    if count > _MAX_POINTS:
        some = torch.randperm(count, generator=generator)[:_MAX_POINTS]
        disparity, inverse_depth, count = disparity[some], inverse_depth[some], _MAX_POINTS
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
    if int(best.sum()) < _MIN_POINTS // 2:
        return None
    together = torch.corrcoef(torch.stack([disparity[best], inverse_depth[best]]))[0, 1]
    return (slope, offset) if slope > 0 and float(together) > _MIN_CORRELATION else None


def _fits(disparity: Tensor, inverse_depth: Tensor, scale: Tensor | float, shift: Tensor | float) -> Tensor:
    return (scale * disparity + shift - inverse_depth).abs() < _TOLERANCE * inverse_depth


def _cells(points: Float[Tensor, "P 3"], cell: float) -> Int[Tensor, " P"]:
    """A number for the cell of every point (the grid spans a million cells a side)."""
    index = (points / cell).floor().long().clamp(-(2**19), 2**19 - 1) + 2**19
    return (index[:, 0] << 40) | (index[:, 1] << 20) | index[:, 2]


def _by_cell(
    points: Float[Tensor, "P 3"],
    colors: Float[Tensor, "P 3"],
    photos: Int[Tensor, " P"],
    votes: Int[Tensor, " S"],
    cell: float,
) -> tuple[Float[Tensor, "C 3"], Float[Tensor, "C 3"], Int[Tensor, " C"]]:
    """Mean place and colour of each cell's points, and the votes of the photos they are from."""
    keys, member = torch.unique(_cells(points, cell), return_inverse=True)
    number = torch.zeros(len(keys)).index_add_(0, member, torch.ones(len(points)))[:, None]
    places = torch.zeros(len(keys), 3).index_add_(0, member, points) / number
    means = torch.zeros(len(keys), 3).index_add_(0, member, colors) / number
    pairs = torch.unique(torch.stack([member, photos]), dim=1)
    return places, means, torch.zeros(len(keys), dtype=torch.int64).index_add_(0, pairs[0], votes[pairs[1]])


def _near(points: Float[Tensor, "P 3"], others: Float[Tensor, "Q 3"], cell: float) -> Bool[Tensor, " P"]:
    """Whether a point shares its cell with one of the others."""
    return torch.isin(_cells(points, cell), _cells(others, cell))


def _seen_through(points: Float[Tensor, "P 3"], photos: Sequence[_Seen], cell: float) -> Int[Tensor, " P"]:
    """How many photos see something clearly beyond each point."""
    through = torch.zeros(len(points), dtype=torch.int64)
    for seen in photos:
        z, depth = _looked_up(points, seen.camera, seen.depth, seen.step)
        through += depth > (1 + 2 * _TOLERANCE) * z + cell
    return through
