"""A day from the lights of photos: which photo was taken at which height of the sun, and which ones show the day.

The luminance of every Gaussian relative to the scene's mean does not depend on exposure. How it varies from photo
to photo is mostly the height of the sun: lit and shaded sides, long shadows, lamps. The axis is learnt for each
scene, from the hours of photos where they are known, otherwise from rough statistics that hold anywhere (under a
low sun photos are warm, dark and of high contrast, and lit sides are warmer than shaded ones).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from wildgs.geometry.spherical_harmonics import C0
from wildgs.light.sun import NOON
from wildgs.model.method import Method

GAUSSIANS = 4096
"""Gaussians whose colours describe a light: those that are largest in the pictures."""

KEYS = 9
"""Photos between which the light of a day changes, at most."""

LEAST_PHOTOS = 5

_ROUGH = (4, 0.1)
_TIMED = (8, 0.005)
"""Principal components, and ridge: times teach the axis on them; rough statistics teach it on the patterns as they
are, with a ridge that is a share of their variance, and only the side of the sun is sought among the components."""

_PHOTOS_PER_COMPONENT = 4
_LEAST_TIMED = 8
"""Photos with a time from which on the order is theirs, if their light agrees."""

_LEAST_AGREEMENT = 0.4
"""Correlation between the height of the sun by time and by light below which times say nothing about this scene."""

_DEVIATIONS, _LEAST_ERROR = 3.0, 30.0
"""A time is wrong if its light differs by so many robust deviations, and at least so many degrees of the sun."""


@dataclass(frozen=True)
class Pattern:
    """What a light does to a scene.

    Attributes:
        luminance: Logarithm of the linear luminance of some Gaussians, less its mean.
        warmth: Logarithm of red over blue of the same Gaussians.
        level: The mean that was taken off.
    """

    luminance: Float[np.ndarray, " M"]
    warmth: Float[np.ndarray, " M"]
    level: float


@dataclass(frozen=True)
class Day:
    """Photos in the order of a day.

    Attributes:
        phases: Height of the sun of each photo that is part of the order, in degrees: of a rising sun as it is, of
            a setting one subtracted from 180. Ascending. Without times the scale is arbitrary.
        keys: Photos that show the day, in order.
        by_time: Whether the order follows the times of photos, not their light alone.
        left_out: Photos whose time does not fit their light, by name, with the reason.
    """

    phases: dict[str, float]
    keys: tuple[str, ...]
    by_time: bool
    left_out: dict[str, str]


@torch.no_grad()
def visible_rows(method: Method, centres: Float[Tensor, "V 3"]) -> Tensor:
    """Indices of the Gaussians, sky apart, that are largest in pictures from these camera centres."""
    gaussians = method.gaussians
    distance = torch.cdist(gaussians.means, centres.to(gaussians.means)).median(dim=1).values.clamp_min(1e-6)
    longest = gaussians.scales.sort(dim=1, descending=True).values
    area = (longest[:, 0] * longest[:, 1] / distance.square()).clamp_max(0.01) * gaussians.opacities.flatten()
    sky = method.sky()
    if sky is not None and not bool(sky.all()):
        area = torch.where(sky, 0.0, area)
    return area.topk(min(GAUSSIANS, len(area))).indices


def pattern_of(sh: Float[Tensor, "N K 3"], rows: Tensor) -> Pattern:
    """The pattern of a light, of the Gaussians at some rows."""
    shown = (0.5 + C0 * sh[rows, 0]).clamp(0.01, 1.2).double().cpu().numpy()
    linear = shown**2.2
    luminance = np.log(linear @ np.array([0.2126, 0.7152, 0.0722]))
    level = float(luminance.mean())
    return Pattern(luminance - level, np.log(linear[:, 0] / linear[:, 2]), level)


def plan_day(patterns: Mapping[str, Pattern], times: Mapping[str, float]) -> Day | None:
    """Orders photos by the height of the sun and chooses those that show the day.

    Args:
        patterns: Of each photo's light, by name.
        times: Phases of the day (`wildgs.light.sun.phase_of`) of the photos whose time is known.

    Returns:
        None if there are fewer than `LEAST_PHOTOS` photos.
    """
    names = list(patterns)
    if len(names) < LEAST_PHOTOS:
        return None
    luminance = np.stack([patterns[name].luminance for name in names])
    timed = [index for index, name in enumerate(names) if name in times]
    if len(timed) >= _LEAST_TIMED:
        phases = np.array([times[names[index]] for index in timed])
        axes = _components(luminance, _TIMED[0])
        kept, agreement = _believable(axes[timed], NOON - np.abs(phases - NOON))
        if agreement >= _LEAST_AGREEMENT:
            left = {
                names[index]: "its light does not fit its time"
                for index, keep in zip(timed, kept, strict=True)
                if not keep
            }
            chosen = [index for index, keep in zip(timed, kept, strict=True) if keep]
            return _day(names, axes, np.array(chosen), phases[kept], left, by_time=True)
    axes = _components(luminance, _ROUGH[0])
    height = _learn(_by_variance(luminance), _rough_height(list(patterns.values())), _ROUGH[1])
    # Light alone does not tell a rising sun from a setting one: the side from which it comes does, but not which is
    # which. The side is taken to be what varies most besides the height.
    side = axes - np.outer(height, axes.T @ height / (height @ height))
    rising = np.linalg.svd(side, full_matrices=False)[0][:, 0] < 0
    rank = (height.argsort().argsort() + 0.5) / len(names) * 180 - 90
    phases = np.where(rising, rank, 180 - rank)
    return _day(names, axes, np.arange(len(names)), phases, {}, by_time=False)


def _components(luminance: Float[np.ndarray, "P M"], count: int) -> Float[np.ndarray, "P C"]:
    """Leading principal components of the patterns, each of unit variance."""
    centred = luminance - luminance.mean(axis=0)
    count = max(2, min(count, len(luminance) // _PHOTOS_PER_COMPONENT))
    left = np.linalg.svd(centred, full_matrices=False)[0][:, :count]
    return left * np.sqrt(len(luminance))


def _by_variance(luminance: Float[np.ndarray, "P M"]) -> Float[np.ndarray, "P _"]:
    """All principal components of the patterns, as they vary, of variance 1 together."""
    left, spread, _ = np.linalg.svd(luminance - luminance.mean(axis=0), full_matrices=False)
    return left * spread * np.sqrt(len(luminance)) / max(np.linalg.norm(spread), 1e-12)


def _rough_height(patterns: Sequence[Pattern]) -> Float[np.ndarray, " P"]:
    """A guess at the order of the heights of the sun, between -0.5 and 0.5."""
    luminance = np.stack([pattern.luminance for pattern in patterns])
    warmth = np.stack([pattern.warmth for pattern in patterns])
    warmth -= warmth.mean(axis=0)
    varied = luminance - luminance.mean(axis=0)
    contrast = varied.std(axis=1)
    together = ((warmth - warmth.mean(axis=1, keepdims=True)) * varied).mean(axis=1)
    level = np.array([pattern.level for pattern in patterns])
    score = _scaled(level) - _scaled(warmth.mean(axis=1)) - _scaled(contrast) - _scaled(together)
    return score.argsort().argsort() / len(score) - 0.5


def _scaled(values: Float[np.ndarray, " P"]) -> Float[np.ndarray, " P"]:
    away = values - np.median(values)
    return away / (np.abs(away).mean() + 1e-9)


def _learn(
    axes: Float[np.ndarray, "P C"],
    target: Float[np.ndarray, " P"],
    ridge: float,
    weights: np.ndarray | None = None,
) -> Float[np.ndarray, " P"]:
    """Ridge regression of a target on the components; its values for all photos."""
    weights = np.ones(len(axes)) if weights is None else weights
    middle = (weights @ target) / weights.sum()
    gram = (axes * weights[:, None]).T @ axes / weights.sum() + ridge * np.eye(axes.shape[1])
    return middle + axes @ np.linalg.solve(gram, axes.T @ (weights * (target - middle)) / weights.sum())


def _believable(axes: Float[np.ndarray, "P C"], heights: Float[np.ndarray, " P"]) -> tuple[np.ndarray, float]:
    """Which heights fit the light, and the correlation between the two for those."""
    weights = np.ones(len(axes))
    error = np.zeros(len(axes))
    for _ in range(20):  # least absolute deviations: wrong times have no say in the end
        error = np.abs(heights - _learn(axes, heights, _TIMED[1], weights))
        weights = 1 / np.maximum(error, 2.0)
    usual = 1.4826 * np.median(error)
    kept = error <= max(_DEVIATIONS * usual, _LEAST_ERROR)
    return kept, _foretold(axes[kept], heights[kept])


def _foretold(axes: Float[np.ndarray, "P C"], heights: Float[np.ndarray, " P"]) -> float:
    """Correlation between heights and what the other photos' heights foretell of each (leave one out)."""
    own = np.einsum("pc,cd,pd->p", axes, np.linalg.inv(axes.T @ axes + 1e-9 * np.eye(axes.shape[1])), axes)
    error = (heights - _learn(axes, heights, _TIMED[1])) / np.maximum(1 - own - 1 / len(axes), 0.05)
    foretold = heights - error
    if min(np.std(foretold), np.std(heights)) < 1e-9:
        return 0.0
    return float(np.corrcoef(foretold, heights)[0, 1])


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
    """One photo for each part of the day: the one whose light is most like that of its neighbours in time."""
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
