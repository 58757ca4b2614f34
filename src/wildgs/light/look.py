"""Looks: the scene under one appearance, mixes of looks, and looks that change over time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from wildgs.errors import UserError
from wildgs.model.appearance import Appearance, Embeddings
from wildgs.model.method import Method

NEUTRAL = "neutral"
"""Name of the mean appearance."""

SUM_TOLERANCE = 1e-3
"""Largest deviation of the sum of weights from 1, to allow for rounding on the command line."""


@dataclass(frozen=True, eq=False)
class Look:
    """An appearance of the scene, from a photo, an image, a file or a mix of several.

    Attributes:
        name: Name for display and file names.
        embeddings: Embeddings of the Gaussians.
        method: The trained method to which the embeddings belong.
        note: How the appearance was obtained, if the user should know.
        sky: The look whose colours the sky has; None for this one.
    """

    name: str
    embeddings: Embeddings = field(repr=False)
    method: Method = field(repr=False)
    note: str = ""
    sky: Look | None = field(default=None, repr=False)

    @cached_property
    def sh(self) -> Float[Tensor, "N K 3"]:
        """Spherical harmonics of all Gaussians under this appearance, on the method's device; cached."""
        with torch.no_grad():
            own = self.method.fuse(self.embeddings)
            which = None if self.sky is None else self.method.sky()
            if self.sky is None or which is None:
                return own
            return torch.where(which[:, None, None], self.sky.sh, own)


@torch.no_grad()
def look_of(method: Method, appearance: Appearance, name: str, note: str = "") -> Look:
    """The look for an appearance."""
    return Look(name, method.embed(appearance), method, note)


def own_look(method: Method) -> Look:
    """The only look of a method that is not relightable."""
    return look_of(method, Appearance(), "own light")


def require_look(look: object) -> None:
    """Raises `UserError` if something else, such as the name of a photo, was given as a look."""
    if not isinstance(look, Look):
        raise UserError(
            f"{str(look)!r} is not an appearance; obtain it first, for example by scene.appearance(name)"
        )


def with_sky(look: Look, sky: Look) -> Look:
    """A look with the sky of another one.

    Raises:
        UserError: The looks are of different scenes, or the method does not separate the sky.
    """
    _require_one_scene([look, sky])
    if look.method.sky() is None:
        raise UserError(f"this run of {look.method.label} does not separate the sky; leave --sky out")
    name = f"{look.name} under the sky of {sky.name}"
    return Look(name, look.embeddings, look.method, look.note, sky.sky or sky)


def mix(
    looks: Sequence[Look],
    weights: Sequence[float | int],
    *,
    local_weights: Sequence[float | int] | None = None,
    name: str | None = None,
) -> Look:
    """Mixes looks (appearance tuning in the paper's appendix Video Demo).

    Args:
        looks: Any number of looks of one scene.
        weights: One weight for each look, with sum 1. Negative weights extrapolate.
        local_weights: Weights of the local embeddings (shadows, lamps), if they differ from those of the global
            embedding (global colour and brightness).
        name: Name of the new look; None describes the mix.

    Raises:
        UserError: The weights are invalid, or the looks are of different scenes.
    """
    if not looks:
        raise UserError("a mix needs at least one appearance")
    for look in looks:
        require_look(look)
    first = looks[0]
    _require_one_scene(looks)
    weights = _checked(looks, weights)
    local = weights if local_weights is None else _checked(looks, local_weights)
    if not first.method.relightable:
        return first
    parts = [look.embeddings for look in looks]
    name = name or _describe(looks, weights, local)
    sky = None
    if any(look.sky for look in looks):
        sky = mix([look.sky or look for look in looks], weights, local_weights=local)
    return Look(name, first.method.mix(parts, weights, local), first.method, sky=sky)


def _require_one_scene(looks: Sequence[Look]) -> None:
    if any(look.method is not looks[0].method for look in looks):
        raise UserError("these appearances belong to different scenes; mix those of one loaded scene")


def _checked(looks: Sequence[Look], weights: Sequence[float | int]) -> list[float]:
    """The weights scaled to an exact sum of 1; raises `UserError` if they are invalid."""
    if len(weights) != len(looks):
        raise UserError(f"{len(looks)} appearances need {len(looks)} weights, not {len(weights)}")
    total = float(sum(weights))
    if not abs(total - 1) <= SUM_TOLERANCE:
        raise UserError(f"the weights of a mix must add up to 1, not to {total:g}")
    return [float(weight) / total for weight in weights]


def _describe(looks: Sequence[Look], weights: Sequence[float | int], local: Sequence[float | int]) -> str:
    def sum_of(parts: Sequence[float | int]) -> str:
        return " + ".join(
            look.name if weight == 1 else f"{weight:.3g} {look.name}"
            for look, weight in zip(looks, parts, strict=True)
            if weight != 0
        )

    return sum_of(weights) if weights == local else f"global {sum_of(weights)}, local {sum_of(local)}"


@dataclass(frozen=True)
class Timeline:
    """A sequence of looks over time with interpolation between them.

    Attributes:
        looks: At least one look.
        pace: Times, ascending from 0 to 1, at which equal parts of the sequence are done; empty for a uniform pace.
    """

    looks: tuple[Look, ...]
    pace: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        """Checks that there is a look, and nothing else."""
        if not self.looks:
            raise UserError("a video needs at least one appearance")
        for look in self.looks:
            require_look(look)

    @classmethod
    def of(cls, looks: Look | Sequence[Look] | Timeline) -> Timeline:
        """Creates a timeline from one look or several."""
        if isinstance(looks, Timeline):
            return looks
        return cls((looks,) if isinstance(looks, Look | str) else tuple(looks))

    def at(self, share: float) -> Look:
        """The look at a time from 0 to 1; looks of the sequence are returned without mixing."""
        share = min(max(share, 0.0), 1.0)
        if self.pace:
            share = float(np.interp(share, self.pace, np.linspace(0, 1, len(self.pace))))
        position = share * (len(self.looks) - 1)
        index = min(int(position), max(len(self.looks) - 2, 0))
        amount = position - index
        if amount < 1e-9:
            return self.looks[index]
        if amount > 1 - 1e-9:
            return self.looks[index + 1]
        return mix([self.looks[index], self.looks[index + 1]], [1 - amount, amount])

    def paced(self, changes: Sequence[float]) -> Timeline:
        """The same looks at a pace at which a measured change is uniform over time.

        Args:
            changes: Change in each of some equal parts of this timeline, not negative.
        """
        done = np.concatenate([[0.0], np.cumsum(changes)])
        return replace(self, pace=tuple((done / done[-1]).tolist()) if done[-1] > 0 else ())
