"""Opening COLMAP's database while other processes use it."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pycolmap

PATIENCE = 20.0
"""How long opening is tried again, seconds."""
FIRST_PAUSE, LONGEST_PAUSE = 0.002, 0.1
"""Seconds between the attempts, the first ones and the last."""


@contextmanager
def open_database(file: Path) -> Iterator[Any]:
    """Opens a database and closes it at the end of the block.

    pycolmap writes to a database when it opens it, and fails without waiting if another process does so at the same
    moment or closes it. Opening is therefore tried again for some time.

    Args:
        file: The database; created if it does not exist.

    Raises:
        RuntimeError: It cannot be opened.
    """
    database = _open_patiently(file)
    try:
        yield database
    finally:
        database.close()


def _open_patiently(file: Path) -> Any:
    deadline, pause = time.monotonic() + PATIENCE, FIRST_PAUSE
    while True:
        try:
            return pycolmap.Database.open(file)
        except RuntimeError:  # as for a file that is no database: pycolmap does not tell them apart
            if not file.parent.is_dir() or time.monotonic() > deadline:
                raise
        time.sleep(pause)
        pause = min(2 * pause, LONGEST_PAUSE)
