"""Options shared by several verbs, and the short help."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Annotated, Any, get_type_hints

import tyro

from wildgs.library.config import MixOptions

NEUTRAL = "neutral"
UNNAMED = tyro.conf.arg(name="")
"""Annotation of a nested dataclass whose options have no prefix."""

Mix = Annotated[MixOptions, UNNAMED]


@dataclass(frozen=True)
class LightOptions(MixOptions):
    """Selection of appearances."""

    appearance: tuple[str, ...] = (NEUTRAL,)
    """Names of photos of the scene, files of new photos or any images, saved appearances, or neutral."""

    @property
    def mixing(self) -> MixOptions:
        """The options without the appearances."""
        return MixOptions(self.weights, self.global_, self.local, self.like, self.sky)


def option_name(path: str) -> str:
    """The option that sets an entry of `config.yaml`: ``train.optimizer.means`` is ``--optimizer.means``."""
    first, _, rest = path.partition(".")
    return f"--{(rest or first).replace('_', '-')}"


def count_options(kind: type) -> int:
    """How many options a command has."""
    hints = get_type_hints(kind)
    nested = [hints[f.name] for f in dataclasses.fields(kind)]
    return sum(count_options(inner) if dataclasses.is_dataclass(inner) else 1 for inner in nested)  # pyright: ignore[reportArgumentType]


def with_only(kind: type, shown: Collection[str], prefix: str = "") -> type:
    """A copy of a command's dataclass that has only some of its options, for the short help.

    Args:
        kind: The command's dataclass.
        shown: Paths of the fields to show, such as ``train.steps``; required fields are always shown.
        prefix: Path of `kind` within the command.
    """
    hints = get_type_hints(kind, include_extras=True)
    plain = get_type_hints(kind)
    fields: list[tuple[str, Any, Any]] = []
    for entry in dataclasses.fields(kind):
        path, hint = prefix + entry.name, hints[entry.name]
        required = entry.default is dataclasses.MISSING and entry.default_factory is dataclasses.MISSING
        if required or path in shown:
            continue
        default = entry.default
        if default is dataclasses.MISSING:
            assert entry.default_factory is not dataclasses.MISSING
            default = entry.default_factory()
        if any(name.startswith(path + ".") for name in shown):
            inner = with_only(plain[entry.name], shown, path + ".")
            value = inner(**{f.name: getattr(default, f.name) for f in dataclasses.fields(inner)})
            metadata = getattr(hint, "__metadata__", ())
            fields.append((entry.name, Annotated[(inner, *metadata)], field(default=value)))  # pyright: ignore[reportInvalidTypeForm]
        else:
            fields.append((entry.name, Annotated[hint, tyro.conf.Suppress], field(default=default)))
    made = dataclasses.make_dataclass(kind.__name__, fields, bases=(kind,), frozen=True, kw_only=True)
    made.__doc__ = kind.__doc__
    return made
