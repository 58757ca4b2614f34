"""Orders photos by the elevation of the sun, and selects photos that show the course of a day.

The luminance of every Gaussian relative to the scene's mean does not depend on exposure. It varies between photos
mostly with the elevation of the sun: lit and shaded sides, long shadows, lamps. A regression for each scene
predicts the elevation from it, trained on capture times if known, otherwise on two estimates that hold for any
scene: the direction of the sun by shading and shadows (`wildgs.light.shadows`), and the colours (with a low sun,
photos are warm, and lit sides are warmer than shaded ones). These estimates are also regressors for capture times,
so that a few of them suffice, and place photos without a capture time between the others.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
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

_COMPONENTS, _HEIGHT_WEIGHT, _RIDGE = 8, 6.0, 1.0
"""Number of principal components on which elevations by time are regressed, weight of the elevation by light beside
them, and ridge of the regression."""

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
        untimed: If so, photos that have no capture time and are placed between the others by light.
        left_out: Photos whose capture time contradicts their light, with the reason.
    """

    phases: dict[str, float]
    keys: tuple[str, ...]
    by_time: bool
    untimed: tuple[str, ...]
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
    patterns: Mapping[str, Pattern], times: Mapping[str, float], suns: Float[np.ndarray, "P 3"]
) -> Day | None:
    """Orders photos by the elevation of the sun and selects key photos.

    Args:
        patterns: Patterns of the photos' lights, by name.
        times: Phases of the day (`wildgs.light.sun.phases_of`) of photos with a capture time.
        suns: Estimated direction of the sun in each photo, in the order of `patterns`, in the aligned frame
            (`SunFinder.direction`).

    Returns:
        None if there are fewer than `LEAST_PHOTOS` photos.
    """
    names = list(patterns)
    if len(names) < LEAST_PHOTOS:
        return None
    luminance = np.stack([patterns[name].luminance for name in names])
    axes, rising = _components(luminance), _is_morning(suns)
    height = _height_by_light(list(patterns.values()), luminance, suns)
    timed = np.array([index for index, name in enumerate(names) if name in times], dtype=int)
    if len(timed) >= _LEAST_TIMED:
        told = np.array([times[names[index]] for index in timed])
        found = _by_time(_predictors(axes, height), rising, timed, told)
        if found is not None:
            phases, wrong = found
            return _day(names, axes, phases, timed, wrong)
    rank = (height.argsort().argsort() + 0.5) / len(names) * 180 - 90
    nobody = np.zeros(0, dtype=int)
    return _day(names, axes, np.where(rising, rank, 180 - rank), nobody, nobody)


def _height_by_light(
    patterns: Sequence[Pattern], luminance: Float[np.ndarray, "P M"], suns: Float[np.ndarray, "P 3"]
) -> Float[np.ndarray, " P"]:
    """The sun's elevation by the light alone, on an arbitrary scale."""
    rough = _rough_height(patterns, suns[:, 2])
    toneless = without_tone(torch.from_numpy(luminance), torch.from_numpy(luminance.mean(axis=0))).numpy()
    return _learn(_by_variance(toneless), rough, _PATTERN_RIDGE)


def _predictors(axes: Float[np.ndarray, "P C"], height: Float[np.ndarray, " P"]) -> Float[np.ndarray, "P _"]:
    """What elevations are regressed on: the elevation by light alone, and, with less weight, the components."""
    height = (height - height.mean()) / max(float(height.std()), 1e-9)
    return np.column_stack([_HEIGHT_WEIGHT * height, axes])


def _by_time(
    predictors: Float[np.ndarray, "P C"],
    rising: Bool[np.ndarray, " P"],
    timed: Int[np.ndarray, " T"],
    told: Float[np.ndarray, " T"],
) -> tuple[Float[np.ndarray, " P"], Int[np.ndarray, " W"]] | None:
    """Phases of all photos by the capture times of some.

    Args:
        predictors: From `_predictors`.
        rising: Whether photos are of the morning, by their shadows.
        timed: Indices of the photos with a capture time.
        told: Phases by these times.

    Returns:
        The phases, by light for photos without a time, and the indices of photos whose time contradicts their
        light. None if times and lights have little in common.
    """
    elevations = NOON - np.abs(told - NOON)
    kept, agreement = _consistent_times(predictors[timed], elevations)
    if agreement < _LEAST_AGREEMENT:
        return None
    right = timed[kept]
    # Shadows tell the halves of the day apart, and times which of them is the morning: south of the tropics, the
    # sun moves to the left.
    if np.mean(rising[right] == (told[kept] < NOON)) < 0.5:
        rising = ~rising
    learned = np.minimum(_learn(predictors, elevations[kept], _RIDGE, rows=right), NOON)
    phases = np.where(rising, learned, 180 - learned)
    phases[timed] = told
    return phases, timed[~kept]


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
    target: Float[np.ndarray, " R"],
    ridge: float,
    weights: Float[np.ndarray, " R"] | None = None,
    rows: Int[np.ndarray, " R"] | None = None,
) -> Float[np.ndarray, " P"]:
    """Predictions for all photos by ridge regression of a target on the components, learned from some rows."""
    known = axes if rows is None else axes[rows]
    weights = np.ones(len(known)) if weights is None else weights
    middle, centre = (weights @ target) / weights.sum(), (weights @ known) / weights.sum()
    centred = known - centre
    gram = (centred * weights[:, None]).T @ centred / weights.sum() + ridge * np.eye(axes.shape[1])
    return middle + (axes - centre) @ np.linalg.solve(
        gram, centred.T @ (weights * (target - middle)) / weights.sum()
    )


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
    centred, count = axes - axes.mean(axis=0), len(axes)
    inverse = np.linalg.inv(centred.T @ centred / count + _RIDGE * np.eye(axes.shape[1])) / count
    own = np.einsum("pc,cd,pd->p", centred, inverse, centred) + 1 / count
    predicted = heights - (heights - _learn(axes, heights, _RIDGE)) / (1 - own)
    if min(np.std(predicted), np.std(heights)) < 1e-9:
        return 0.0
    return float(np.corrcoef(predicted, heights)[0, 1])


def _day(
    names: list[str],
    axes: Float[np.ndarray, "P C"],
    phases: Float[np.ndarray, " P"],
    timed: Int[np.ndarray, " T"],
    wrong: Int[np.ndarray, " W"],
) -> Day:
    """The day of photos with these phases, without those of wrong capture times."""
    shown = np.setdiff1d(np.arange(len(names)), wrong)
    order = shown[np.argsort(phases[shown], kind="stable")]
    keys = _smooth_keys(axes[order], phases[order])
    by_time = len(timed) > 0
    return Day(
        phases={names[index]: round(float(phases[index]), 2) for index in order},
        keys=tuple(names[order[key]] for key in keys),
        by_time=by_time,
        untimed=tuple(names[index] for index in order if index not in timed) if by_time else (),
        left_out={names[index]: "its capture time contradicts its light" for index in wrong},
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
