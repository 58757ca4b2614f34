"""Frozen dataclasses as dicts, lists, strings and numbers, and back."""

from __future__ import annotations

import dataclasses
import reprlib
import types
import typing
from pathlib import Path
from typing import Any, Literal, Protocol, runtime_checkable

from wildgs.errors import UserError


@runtime_checkable
class Upgradable(Protocol):
    """A dataclass that converts plain values of earlier versions, or whose types depend on its values."""

    @classmethod
    def upgraded(cls, plain: dict[Any, Any], where: str) -> tuple[dict[Any, Any], dict[str, Any]]:
        """The plain values in the current form, and the types of entries that depend on them.

        Args:
            plain: Plain values; not changed.
            where: Path of the dataclass, for messages.

        Raises:
            UserError: The types cannot be determined.
        """
        ...


def to_plain(value: Any) -> Any:
    """Converts a configuration to dicts, lists, strings and numbers."""
    if type(value).__module__ == "numpy":  # np.float32(2), for example
        return value.item()
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: to_plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, (tuple, list)):
        return [to_plain(item) for item in value]
    return str(value) if isinstance(value, Path) else value


def from_plain(kind: Any, value: Any, where: str = "config") -> Any:
    """The inverse of `to_plain`; missing entries take their defaults.

    Args:
        kind: Type to convert to.
        value: Plain value.
        where: Path of the entry, for messages.

    Raises:
        UserError: An entry is unknown or has the wrong type.
    """
    if dataclasses.is_dataclass(kind):
        return _dataclass_from_plain(kind, value, where)
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is Literal and value in arguments:
        return value
    if origin in (typing.Union, types.UnionType):
        return _union_from_plain(arguments, value, where)
    if origin is tuple and isinstance(value, list):
        inner = arguments[:1] * len(value) if arguments[-1] is Ellipsis else arguments
        if len(inner) == len(value):
            return tuple(from_plain(k, v, where) for k, v in zip(inner, value, strict=True))
    if kind is Path and isinstance(value, str):
        return Path(value)
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if isinstance(kind, type) and type(value) is kind and value == value:  # rejects NaN
        return value
    raise UserError(f"{where}: {reprlib.repr(value)} is not a {getattr(kind, '__name__', kind)}")


def _dataclass_from_plain(kind: Any, value: Any, where: str) -> Any:
    if not isinstance(value, dict):
        raise UserError(f"{where}: expected a mapping, found {reprlib.repr(value)}")
    hints = entry_types(kind)
    required = {f.name for f in dataclasses.fields(kind) if _is_required(f)}
    if issubclass(kind, Upgradable):
        value, own_hints = kind.upgraded(value, where)
        hints |= own_hints
    known = set(hints)
    if unknown := sorted(map(str, set(value) - known)):
        raise UserError(f"{where}: unknown entry {unknown[0][:80]!r}; choose from {', '.join(sorted(known))}")
    if missing := sorted(required - set(value)):
        raise UserError(f"{where}: the entry {missing[0]!r} is missing")
    return kind(**{name: from_plain(hints[name], entry, f"{where}.{name}") for name, entry in value.items()})


def entry_types(kind: Any) -> dict[str, Any]:
    """Names and types of a dataclass's fields."""
    hints = typing.get_type_hints(kind)
    return {f.name: hints[f.name] for f in dataclasses.fields(kind)}


def _is_required(entry: dataclasses.Field[Any]) -> bool:
    return entry.default is dataclasses.MISSING and entry.default_factory is dataclasses.MISSING


def _union_from_plain(kinds: tuple[Any, ...], value: Any, where: str) -> Any:
    if value is None and type(None) in kinds:
        return None
    for kind in kinds:
        try:
            return from_plain(kind, value, where)
        except UserError:
            continue
    names = " or ".join("None" if k is type(None) else getattr(k, "__name__", str(k)) for k in kinds)
    raise UserError(f"{where}: {reprlib.repr(value)} is not of type {names}")


def flat(plain: Any, path: str = "") -> dict[str, Any]:
    """Paths such as ``train.density.max_gaussians`` and their values."""
    if not isinstance(plain, dict):
        return {path: plain}
    parts = (flat(value, f"{path}.{name}" if path else name) for name, value in plain.items())
    return {key: value for part in parts for key, value in part.items()}
