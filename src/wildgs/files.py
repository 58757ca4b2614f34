"""Files that are there whole or not at all."""

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
