"""Orders photos by the elevation of the sun, and selects photos that show the course of a day.

The luminance of every Gaussian relative to the scene's mean does not depend on exposure. It varies between photos
mostly with the elevation of the sun: lit and shaded sides, long shadows, lamps. A regression for each scene
predicts the elevation from it, trained on capture times if known, otherwise on two estimates that hold for any
scene: the direction of the sun by shading and shadows (`wildgs.light.shadows`), and the colours (with a low sun,
photos are warm, and lit sides are warmer than shaded ones).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from wildgs.geometry.spherical_harmonics import C0
from wildgs.light.shadows import without_tone
from wildgs.light.sun import NOON
from wildgs.model.method import Method

GAUSSIANS = 4096
"""Number of Gaussians whose colours describe a light: those that are largest in the images."""

KEYS = 9
"""Upper bound on the number of key photos of a day."""

LEAST_PHOTOS = 5

_COMPONENTS, _RIDGE = 8, 0.005
"""Number of principal components on which times are regressed, and ridge of the regression."""

_PATTERN_RIDGE = 0.02
"""Ridge of the regression of estimates on the unwhitened patterns, relative to their variance."""

_PHOTOS_PER_COMPONENT = 4
_LEAST_TIMED = 8
"""Smallest number of photos with a capture time for ordering by time."""

_LEAST_AGREEMENT = 0.4
"""Smallest correlation between the sun's elevation by time and by light for ordering by time."""

_DEVIATIONS, _LEAST_ERROR = 3.0, 30.0
"""A capture time is rejected if its error exceeds both this number of robust standard deviations and of degrees."""


@dataclass(frozen=True)
class Pattern:
    """Description of a light.

    Attributes:
        luminance: Log luminance of some Gaussians minus its mean.
        warmth: Logarithm of red over blue of the same Gaussians.
    """

    luminance: Float[np.ndarray, " M"]
    warmth: Float[np.ndarray, " M"]


@dataclass(frozen=True)
class Day:
    """Photos in the order of a day.

    Attributes:
        phases: Elevation of the sun for each photo in degrees, before noon; 180 minus the elevation after noon.
            Ascending. Without capture times the scale is arbitrary.
        keys: Key photos of the day, in order.
        by_time: Whether photos are ordered by capture time instead of by light.
        left_out: Photos whose capture time contradicts their light, with the reason.
    """

    phases: dict[str, float]
    keys: tuple[str, ...]
    by_time: bool
    left_out: dict[str, str]


@torch.no_grad()
def visible_rows(method: Method, centres: Float[Tensor, "V 3"]) -> Tensor:
    """Indices of the Gaussians, without the sky, that are largest in images from these camera centres."""
    gaussians = method.gaussians
    distance = torch.cdist(gaussians.means, centres.to(gaussians.means)).median(dim=1).values.clamp_min(1e-6)
    longest = gaussians.scales.sort(dim=1, descending=True).values
    area = (longest[:, 0] * longest[:, 1] / distance.square()).clamp_max(0.01) * gaussians.opacities.flatten()
    sky = method.sky()
    if sky is not None and not bool(sky.all()):
        area = torch.where(sky, 0.0, area)
    return area.topk(min(GAUSSIANS, len(area))).indices


def pattern_of(sh: Float[Tensor, "M K 3"]) -> Pattern:
    """The pattern of a light on some Gaussians (`visible_rows`)."""
    shown = (0.5 + C0 * sh[:, 0]).clamp(0.01, 1.2).double().cpu().numpy()
    linear = shown**2.2
    luminance = np.log(linear @ np.array([0.2126, 0.7152, 0.0722]))
    warmth = np.log(linear[:, 0] / linear[:, 2])
    return Pattern(luminance - luminance.mean(), warmth)


def plan_day(
    patterns: Mapping[str, Pattern],
    times: Mapping[str, float],
    find_suns: Callable[[], Float[np.ndarray, "P 3"]],
) -> Day | None:
    """Orders photos by the elevation of the sun and selects key photos.

    Args:
        patterns: Patterns of the photos' lights, by name.
        times: Phases of the day (`wildgs.light.sun.phase_of`) of photos with a capture time.
        find_suns: Estimates the direction of the sun in each photo, in the order of `patterns`, in the aligned
            frame (`SunFinder.direction`). Called only if the times do not decide.

    Returns:
        None if there are fewer than `LEAST_PHOTOS` photos.
    """
    names = list(patterns)
    if len(names) < LEAST_PHOTOS:
        return None
    luminance = np.stack([patterns[name].luminance for name in names])
    axes = _components(luminance)
    timed = [index for index, name in enumerate(names) if name in times]
    if len(timed) >= _LEAST_TIMED:
        phases = np.array([times[names[index]] for index in timed])
        kept, agreement = _consistent_times(axes[timed], NOON - np.abs(phases - NOON))
        if agreement >= _LEAST_AGREEMENT:
            left = {
                names[index]: "its capture time contradicts its light"
                for index, keep in zip(timed, kept, strict=True)
                if not keep
            }
            chosen = [index for index, keep in zip(timed, kept, strict=True) if keep]
            return _day(names, axes, np.array(chosen), phases[kept], left, by_time=True)
    suns = find_suns()
    rough = _rough_height(list(patterns.values()), suns[:, 2])
    toneless = without_tone(torch.from_numpy(luminance), torch.from_numpy(luminance.mean(axis=0))).numpy()
    height = _learn(_by_variance(toneless), rough, _PATTERN_RIDGE)
    rising = _is_morning(suns)
    rank = (height.argsort().argsort() + 0.5) / len(names) * 180 - 90
    phases = np.where(rising, rank, 180 - rank)
    return _day(names, axes, np.arange(len(names)), phases, {}, by_time=False)


def _components(luminance: Float[np.ndarray, "P M"]) -> Float[np.ndarray, "P C"]:
    """Leading principal components of the patterns, each of unit variance."""
    centred = luminance - luminance.mean(axis=0)
    count = max(2, min(_COMPONENTS, len(luminance) // _PHOTOS_PER_COMPONENT))
    return np.linalg.svd(centred, full_matrices=False)[0][:, :count] * np.sqrt(len(luminance))


def _by_variance(luminance: Float[np.ndarray, "P M"]) -> Float[np.ndarray, "P _"]:
    """All principal components of the patterns, unwhitened, with a total variance of 1."""
    left, spread, _ = np.linalg.svd(luminance - luminance.mean(axis=0), full_matrices=False)
    return left * spread * np.sqrt(len(luminance)) / max(np.linalg.norm(spread), 1e-12)


def _rough_height(patterns: Sequence[Pattern], shadows: Float[np.ndarray, " P"]) -> Float[np.ndarray, " P"]:
    """An estimate of the ranks of the sun's elevations, scaled to -0.5 to 0.5.

    Args:
        patterns: Patterns of the photos' lights.
        shadows: Upward component of the directions of the sun.
    """
    luminance, warmth = (
        np.stack(values) - np.mean(values, axis=0)
        for values in ([each.luminance for each in patterns], [each.warmth for each in patterns])
    )
    lit_warmer = ((warmth - warmth.mean(axis=1, keepdims=True)) * luminance).mean(axis=1)
    colors = _ranks(-_ranks(warmth.mean(axis=1)) - _ranks(lit_warmer))
    return _ranks(colors + 2 * _ranks(shadows))  # shadows are the better estimate (docs/decisions.md)


def _ranks(values: Float[np.ndarray, " P"]) -> Float[np.ndarray, " P"]:
    """Ranks of values, scaled to -0.5 to 0.5."""
    return (values.argsort(kind="stable").argsort() + 0.5) / len(values) - 0.5


def _is_morning(suns: Float[np.ndarray, "P 3"]) -> Bool[np.ndarray, " P"]:
    """Whether the sun is to the left of its mean direction, as in the morning north of the tropics."""
    mean = suns[:, :2].sum(axis=0)
    return mean[0] * suns[:, 1] - mean[1] * suns[:, 0] > 0


def _learn(
    axes: Float[np.ndarray, "P C"],
    target: Float[np.ndarray, " P"],
    ridge: float,
    weights: np.ndarray | None = None,
) -> Float[np.ndarray, " P"]:
    """Predictions for all photos by ridge regression of a target on the components."""
    weights = np.ones(len(axes)) if weights is None else weights
    middle = (weights @ target) / weights.sum()
    gram = (axes * weights[:, None]).T @ axes / weights.sum() + ridge * np.eye(axes.shape[1])
    return middle + axes @ np.linalg.solve(gram, axes.T @ (weights * (target - middle)) / weights.sum())


def _consistent_times(
    axes: Float[np.ndarray, "P C"], heights: Float[np.ndarray, " P"]
) -> tuple[np.ndarray, float]:
    """Mask of the elevations that are consistent with the light, and their cross-validated correlation with it."""
    weights = np.ones(len(axes))
    error = np.zeros(len(axes))
    for _ in range(20):  # least absolute deviations, robust against wrong times
        error = np.abs(heights - _learn(axes, heights, _RIDGE, weights))
        weights = 1 / np.maximum(error, 2.0)
    usual = 1.4826 * np.median(error)
    kept = error <= max(_DEVIATIONS * usual, _LEAST_ERROR)
    return kept, _cross_validated(axes[kept], heights[kept])


def _cross_validated(axes: Float[np.ndarray, "P C"], heights: Float[np.ndarray, " P"]) -> float:
    """Correlation between elevations and their leave-one-out predictions."""
    own = np.einsum("pc,cd,pd->p", axes, np.linalg.inv(axes.T @ axes + 1e-9 * np.eye(axes.shape[1])), axes)
    error = (heights - _learn(axes, heights, _RIDGE)) / np.maximum(1 - own - 1 / len(axes), 0.05)
    predicted = heights - error
    if min(np.std(predicted), np.std(heights)) < 1e-9:
        return 0.0
    return float(np.corrcoef(predicted, heights)[0, 1])


def _day(
    names: list[str],
    axes: Float[np.ndarray, "P C"],
    chosen: np.ndarray,
    phases: Float[np.ndarray, " Q"],
    left_out: dict[str, str],
    *,
    by_time: bool,
) -> Day:
    order = np.argsort(phases, kind="stable")
    chosen, phases = chosen[order], phases[order]
    keys = _smooth_keys(axes[chosen], phases)
    return Day(
        {names[index]: round(float(phase), 2) for index, phase in zip(chosen, phases, strict=True)},
        tuple(names[chosen[key]] for key in keys),
        by_time,
        left_out,
    )


def _smooth_keys(axes: Float[np.ndarray, "Q C"], phases: Float[np.ndarray, " Q"]) -> list[int]:
    """One photo for each part of the day, whose light is most similar to the average of its neighbours in time."""
    spacing = max(np.ptp(phases), 1e-6) / KEYS
    near = np.exp(-0.5 * ((phases[:, None] - phases[None]) / spacing) ** 2)
    local = near @ axes / near.sum(axis=1, keepdims=True)
    oddity = np.linalg.norm(axes - local, axis=1)
    part = np.minimum(((phases - phases[0]) / spacing).astype(int), KEYS - 1)
    return [
        int(members[oddity[members].argmin()])
        for members in (np.flatnonzero(part == number) for number in range(KEYS))
        if len(members)
    ]
