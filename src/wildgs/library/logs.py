"""A run's own log: what the console showed of warnings, and why training ended."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from wildgs.errors import UserError

LOG_FILE = "train.log"

logger = logging.getLogger("wildgs")


@contextmanager
def run_log(folder: Path) -> Iterator[None]:
    """Appends to the run's log while the block runs; a disk that refuses is passed over."""
    logging.raiseExceptions = False  # a full disk must not fill the console with tracebacks of the log
    try:
        handler = logging.FileHandler(folder / LOG_FILE, encoding="utf-8", errors="backslashreplace")
    except OSError:
        yield
        return
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
    level = logger.level
    logger.addHandler(handler)
    logger.setLevel(logging.DEBUG)
    try:
        yield
    except UserError as error:
        logger.error("stopped: %s", error)
        raise
    except KeyboardInterrupt as error:
        logger.debug("%s", error or "interrupted")  # the caller reports it
        raise
    except Exception:
        logger.exception("training failed")
        raise
    finally:
        logger.removeHandler(handler)
        logger.setLevel(level)
        with contextlib.suppress(OSError):
            handler.close()
