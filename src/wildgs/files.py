"""Reading and writing files: atomic writes, regular files only, and file names as text."""

from __future__ import annotations

import hashlib
import json
import os
import stat
import unicodedata
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from wildgs.errors import UserError

MAX_NAME_BYTES = 255
"""Longest file name that common file systems allow."""

_BIDI_CONTROLS = "\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069"

ASIDE_SUFFIX = ".part"
FINGERPRINT_BYTES = 65_536


@contextmanager
def written_aside(file: Path, *, flush: bool = False) -> Iterator[Path]:
    """Atomic write: gives a temporary path beside `file`, which is renamed to `file` when the block ends well.

    Readers see the old file or the whole new one. When the block fails, the temporary file is removed and the old
    file stays. The new file has the permissions that the process gives to any new file (its umask), whatever the
    code in the block created it with.

    Args:
        file: The file to write; its folder is created if it does not exist.
        flush: Whether to wait until file and folder are on the disk (fsync), so that they survive a power cut.

    Raises:
        UserError: The file cannot be written, for example because the disk is full or the folder is read-only.
    """
    aside = _aside(file)
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        try:
            with aside.open("wb"):
                pass
            mode = stat.S_IMODE(aside.stat().st_mode)
            yield aside
            if stat.S_IMODE(aside.stat().st_mode) != mode:
                aside.chmod(mode)
            if flush:
                _flush(aside)
            aside.replace(file)
            if flush:
                _flush(file.parent)
        except BaseException:
            aside.unlink(missing_ok=True)
            raise
    except OSError as error:
        raise UserError(
            f"{file} cannot be written ({error}); free disk space, fix permissions or choose another place"
        ) from error


def _aside(file: Path) -> Path:
    """A hidden name in the same folder, of this process alone and short enough for any file system."""
    ending = f".{os.getpid()}{ASIDE_SUFFIX}"
    name = file.name
    if len(os.fsencode(name)) + 1 + len(ending) > MAX_NAME_BYTES:
        name = hashlib.sha256(os.fsencode(name)).hexdigest()[:32]
    return file.with_name(f".{name}{ending}")


def remove_leftovers(folder: Path) -> None:
    """Removes temporary files of killed processes from a folder that no other process is writing to."""
    for leftover in folder.glob(f".*{ASIDE_SUFFIX}"):
        leftover.unlink(missing_ok=True)


def _flush(path: Path) -> None:
    """Waits until a file, or the entries of a folder, are on the disk."""
    if path.is_dir() and os.name == "nt":  # folders cannot be opened there
        return
    handle = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def is_file(path: Path) -> bool:
    """Whether a path is a regular file or a link to one; False for invalid names."""
    try:
        return path.is_file()
    except (OSError, ValueError):  # a name that is too long, a null character
        return False


def is_there(path: Path) -> bool:
    """Whether a path exists, as a file of any kind or a broken link; False for invalid names."""
    try:
        return path.is_symlink() or path.exists()
    except (OSError, ValueError):
        return False


def fingerprint(path: Path) -> str:
    """A short digest of a file's size, beginning and end; empty if the file cannot be read."""
    try:
        check_regular(path)
        with path.open("rb") as file:
            size = file.seek(0, os.SEEK_END)
            digest = hashlib.sha256(str(size).encode())
            for start in (0, max(0, size - FINGERPRINT_BYTES)):
                file.seek(start)
                digest.update(file.read(FINGERPRINT_BYTES))
    except OSError:
        return ""
    return digest.hexdigest()[:16]


def check_regular(path: Path) -> None:
    """Rejects pipes, sockets and devices such as /dev/zero, which could be read endlessly.

    Raises:
        OSError: The path is not a regular file, does not exist or is not accessible.
    """
    if not stat.S_ISREG(path.stat().st_mode):
        raise OSError("not a regular file")


def read_json(path: Path) -> Any:
    """The content of a JSON file.

    Raises:
        OSError: It is not a regular file, or cannot be read.
        ValueError: It is not JSON, or is nested too deeply.
    """
    check_regular(path)
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error


def printable(name: str) -> str:
    r"""A file name as printable text.

    Bytes that are not UTF-8, control characters, line ends and bidirectional control characters are replaced by
    escapes such as `\xe9`.
    """
    return "".join(_escaped(character) if is_unprintable(character) else character for character in name)


def is_unprintable(character: str) -> bool:
    """Whether a character of a name is a control character or a byte that is not UTF-8."""
    return unicodedata.category(character) in ("Cc", "Cs", "Zl", "Zp") or character in _BIDI_CONTROLS


def _escaped(character: str) -> str:
    code = ord(character)
    if 0xDC80 <= code <= 0xDCFF:  # Python's surrogateescape of a byte that is not UTF-8
        return f"\\x{code - 0xDC00:02x}"
    return character.encode("unicode_escape").decode("ascii")


def describe_names(names: Sequence[str], limit: int = 3) -> str:
    """The first few names and the number of the others, for a message."""
    shown = ", ".join(names[:limit])
    return shown if len(names) <= limit else f"{shown} and {len(names) - limit} more"
