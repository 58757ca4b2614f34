"""The option `--appearance` of every verb that shows a scene in some light."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import tyro

from wildgs.api import LoadedScene
from wildgs.cli.progress import console, stages
from wildgs.errors import UserError
from wildgs.light.look import NEUTRAL, Look, mix


@dataclass(frozen=True)
class MixOptions:
    """How appearances are found and mixed."""

    weights: tuple[float, ...] = ()
    """Mix the appearances into one, in these parts; they add up to 1."""
    global_: Annotated[str | None, tyro.conf.arg(name="global")] = None
    """Take the colour and brightness of it all from this appearance instead."""
    local: str | None = None
    """Take what differs from place to place (shadows, lamps) from this appearance instead."""
    like: str | None = None
    """Photo of the scene whose camera and depth a picture borrows, or auto: it is not localised then."""


@dataclass(frozen=True)
class LightOptions(MixOptions):
    """Where the light comes from."""

    appearance: tuple[str, ...] = (NEUTRAL,)
    """Photos of the scene by name, files of new photos or any pictures, saved appearances, or neutral."""


def find_looks(scene: LoadedScene, options: MixOptions, specs: Sequence[str]) -> list[Look]:
    """The looks that the options ask for: one for each appearance, or a single mixed one.

    Shows progress, and how new photos were found.

    Raises:
        UserError: An appearance cannot be had, or the options contradict each other.
    """
    apart = options.global_ is not None or options.local is not None
    if apart and options.global_ is not None and options.local is not None:
        specs = ()  # nothing is left to come from elsewhere
    looks = [find_look(scene, spec, options.like) for spec in specs]
    if options.weights:
        looks = [mix(looks, options.weights)]
    if not apart:
        return looks
    if len(looks) > 1:
        raise UserError("--global and --local change one appearance; give one, or --weights to mix several")
    parts = [
        looks[0] if spec is None else find_look(scene, spec, options.like)
        for spec in (options.global_, options.local)
    ]
    return [mix(parts, [1, 0], local_weights=[0, 1])]


def find_look(scene: LoadedScene, spec: str, like: str | None = None) -> Look:
    """One look, with progress; says how a new photo was found."""
    with stages() as progress:
        look = scene.appearance(spec, like=like, progress=progress)
    if look.note:
        console.print(f"{spec}: {look.note}")
    return look
