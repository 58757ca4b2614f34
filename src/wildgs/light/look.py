"""A look: the scene under one appearance, shaded once; mixes of looks, and looks that change over time."""

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
"""The name of the mean light."""

SUM_TOLERANCE = 1e-3
"""How far from one the weights of a mix may add up: rounded weights on a command line are no mistake."""


@dataclass(frozen=True, eq=False)
class Look:
    """The appearance of a whole scene, from a photo, a picture, a file or a mix of those.

    Attributes:
        name: For people and for file names.
        embeddings: What `mix` mixes.
        method: The trained method to which the embeddings belong.
        note: How the light was found, where that is worth a line to the user.
        sky: The look from which the sky's colours are taken; None takes this one's.
    """

    name: str
    embeddings: Embeddings = field(repr=False)
    method: Method = field(repr=False)
    note: str = ""
    sky: Look | None = field(default=None, repr=False)

    @cached_property
    def sh(self) -> Float[Tensor, "N K 3"]:
        """Spherical harmonics of all Gaussians under this light, on the method's device; shaded once, then kept."""
        with torch.no_grad():
            own = self.method.fuse(self.embeddings)
            which = None if self.sky is None else self.method.sky()
            if self.sky is None or which is None:
                return own
            return torch.where(which[:, None, None], self.sky.sh, own)


@torch.no_grad()
def look_of(method: Method, appearance: Appearance, name: str, note: str = "") -> Look:
    """The look of an encoded photo."""
    return Look(name, method.embed(appearance), method, note)


def own_look(method: Method) -> Look:
    """The one look of a method that is not relightable."""
    return look_of(method, Appearance(), "own light")


def with_sky(look: Look, sky: Look) -> Look:
    """A look with the sky of another; depth and alpha do not depend on either.

    Raises:
        UserError: The looks are of different scenes, or the method does not tell the sky from the scene.
    """
    _require_one_scene([look, sky])
    if look.method.sky() is None:
        raise UserError(f"this run of {look.method.label} has no sky apart from the scene; leave --sky out")
    name = f"{look.name} under the sky of {sky.name}"
    return Look(name, look.embeddings, look.method, look.note, sky.sky or sky)


def mix(
    looks: Sequence[Look],
    weights: Sequence[float | int],
    *,
    local_weights: Sequence[float | int] | None = None,
    name: str | None = None,
) -> Look:
    """Tuning: a look between others (paper, appendix Video Demo), at the cost of one shading, no encoding.

    Args:
        looks: Any number of looks of one scene.
        weights: One for each, adding up to one. Negative ones extrapolate.
        local_weights: For the local embeddings (shadows, lamps, what lies where), where they shall be mixed in
            other parts than the global one (colour and brightness of it all).
        name: Of the new look; None describes the mix.

    Raises:
        UserError: The weights do not fit the looks or do not add up to one, or the looks are of different scenes.
    """
    if not looks:
        raise UserError("a mix needs at least one appearance")
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
    """The weights as they were given, but for rounding: scaled to add up to one exactly."""
    if len(weights) != len(looks):
        raise UserError(f"{len(looks)} appearances need {len(looks)} weights, not {len(weights)}")
    total = float(sum(weights))
    if not abs(total - 1) <= SUM_TOLERANCE:
        raise UserError(f"the weights of a mix must add up to 1, these add up to {total:g}")
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
    """Looks one after the other over time; between two of them their mix.

    Attributes:
        looks: At least one; a single one does not change.
        pace: Shares of the time, ascending from 0 to 1, at which even parts of the way are done; empty for an even
            pace.
    """

    looks: tuple[Look, ...]
    pace: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        """Refuse what shows nothing."""
        if not self.looks:
            raise UserError("a video needs at least one appearance")

    @classmethod
    def of(cls, looks: Look | Sequence[Look] | Timeline) -> Timeline:
        """One look, or several over time."""
        if isinstance(looks, Timeline):
            return looks
        return cls((looks,) if isinstance(looks, Look) else tuple(looks))

    def at(self, share: float) -> Look:
        """The look at a share of the time, from 0 to 1.

        At the looks themselves no mixing and no new shading takes place.
        """
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
        """The same looks, at a pace at which a change is spread evenly over time.

        Args:
            changes: How much changes in each of some even parts of this timeline, not negative.
        """
        done = np.concatenate([[0.0], np.cumsum(changes)])
        return replace(self, pace=tuple((done / done[-1]).tolist()) if done[-1] > 0 else ())
