"""Checks of a command's arguments before its options are parsed."""

from __future__ import annotations

from collections.abc import Collection

from wildgs.errors import UserError


def refuse_empty(arguments: list[str]) -> None:
    """Raises `UserError` for an empty argument, which would be read as the current folder; a title may be empty."""
    for before, argument in zip(["", *arguments], arguments, strict=False):
        option, equals, value = argument.partition("=")
        if before != "--title" and (not argument or (option.startswith("--") and equals and not value)):
            which = f" of {before}" if before.startswith("--") else f" of {option}" if equals else ""
            raise UserError(f"the value{which} is empty; give one (an unset variable of the shell is empty)")


def refuse_repeated(arguments: list[str], repeatable: Collection[str] = ()) -> None:
    """Raises `UserError` for an option that is given twice, because only its last values would be used.

    Args:
        arguments: Arguments of a command.
        repeatable: Options that add up, such as ``--variant``.
    """
    given: dict[str, str] = {}
    for argument in arguments:
        if argument == "--":  # what follows are values
            return
        if not argument.startswith("--"):
            continue
        option = argument.partition("=")[0]
        name = _positive(option)
        if name in repeatable:
            continue
        if name not in given:
            given[name] = option
        elif given[name] == option:
            raise UserError(f"{option} is given twice; give it once, followed by all its values")
        else:
            raise UserError(f"{given[name]} and {option} set the same option; give one of them")


def _positive(option: str) -> str:
    """The name of an option with - for _ and without the ``no-`` of a switch, as in ``--density.no-revise``."""
    group, dot, name = option[2:].replace("_", "-").strip("-").rpartition(".")
    return f"--{group}{dot}{name.removeprefix('no-')}"
