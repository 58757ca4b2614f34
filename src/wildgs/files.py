"""Files that are there whole or not at all, and their names as text."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from wildgs.errors import UserError


@contextmanager
def written_aside(file: Path) -> Iterator[Path]:
    """A place beside a file, which takes its name when the block ends well; nothing half is left in any case.

    Args:
        file: What is to be written; its folder is made where it is missing.

    Raises:
        UserError: The disk is full, or the folder cannot be written to.
    """
    aside = file.with_name(f".{file.name}.part")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        try:
            yield aside
            aside.replace(file)
        except BaseException:
            aside.unlink(missing_ok=True)
            raise
    except OSError as error:
        raise UserError(f"{file} cannot be written ({error}); make room or choose another place") from error


def printable(name: str) -> str:
    r"""A file's name as text that every screen, page and text file can hold.

    Names are bytes on most systems. Bytes that are not UTF-8 and characters that do not print (control characters,
    reversed writing) are shown as escapes such as `\xe9`.
    """
    return "".join(character if character.isprintable() else _escaped(character) for character in name)


def _escaped(character: str) -> str:
    code = ord(character)
    if 0xDC80 <= code <= 0xDCFF:  # how Python holds a byte that is not UTF-8
        return f"\\x{code - 0xDC00:02x}"
    return character.encode("unicode_escape").decode("ascii")
