"""What a bug report needs, as text to paste: versions, hardware, configuration, last log lines, and no names."""

from __future__ import annotations

import getpass
import importlib.metadata
import platform
import re
import socket
from collections.abc import Sequence
from pathlib import Path

from wildgs.library.logs import LOG_FILE
from wildgs.runs import CONFIG_FILE

PACKAGES = (
    "wildgs",
    "torch",
    "numpy",
    "numba",
    "pycolmap",
    "transformers",
    "pillow",
    "safetensors",
    "gsplat",
)
LOG_LINES = 60
LOG_BYTES = 200_000
METRIC_LINES = 5
_HOMES = re.compile(r"(/home/|/Users/|[A-Za-z]:\\Users\\)[^/\\\s'\":]+")


def write_report(checks: Sequence[tuple[str, str, str]], run: Path | None) -> str:
    """The report.

    Args:
        checks: Name, state and detail of what `wildgs doctor` looked at.
        run: A run folder whose configuration and log go along.
    """
    parts = ["## Versions", *_versions(), "", "## This machine"]
    parts += [f"- {name}: {state}: {detail}" for name, state, detail in checks]
    if run is not None:
        parts += ["", "## Configuration", "```yaml", _tail(run / CONFIG_FILE, 500), "```"]
        parts += ["", "## Last log lines", "```", _tail(run / LOG_FILE, LOG_LINES), "```"]
        parts += ["", "## Last metrics", "```", _tail(run / "metrics.jsonl", METRIC_LINES), "```"]
        checkpoints = sorted((run / "checkpoints").glob("*")) if (run / "checkpoints").is_dir() else []
        parts += ["", "## Checkpoints", *(f"- {p.name}: {p.stat().st_size:,} bytes" for p in checkpoints)]
    return without_names("\n".join(parts))


def without_names(text: str) -> str:
    """The text without the user's home folder, the user's and the machine's name."""
    home = str(Path.home())
    if len(home) > 1:
        text = text.replace(home, "~")
    text = _HOMES.sub("~", text)
    for name, stand_in in ((_user(), "USER"), (socket.gethostname(), "HOST")):
        if name:
            text = re.sub(rf"(?<![A-Za-z0-9]){re.escape(name)}(?![A-Za-z0-9])", stand_in, text)
    return text


def _user() -> str:
    try:
        return getpass.getuser()
    except Exception:  # a user without an entry in the system's list
        return ""


def _versions() -> list[str]:
    lines = [f"- Python {platform.python_version()} on {platform.system()} {platform.machine()}"]
    for package in PACKAGES:
        try:
            lines.append(f"- {package} {importlib.metadata.version(package)}")
        except importlib.metadata.PackageNotFoundError:
            lines.append(f"- {package}: not installed")
    return lines


def _tail(path: Path, count: int) -> str:
    """The last lines of a file, however long it is."""
    try:
        with path.open("rb") as file:
            file.seek(0, 2)
            file.seek(max(0, file.tell() - LOG_BYTES))
            text = file.read().decode("utf-8", errors="replace")
    except OSError as error:
        return f"(cannot be read: {error})"
    return "\n".join(text.splitlines()[-count:])
