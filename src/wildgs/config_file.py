"""The YAML file of a run's configuration."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml
import yaml.composer

from wildgs.config import RunConfig
from wildgs.errors import UserError
from wildgs.files import check_regular, written_aside
from wildgs.plain_values import from_plain, to_plain

CONFIG_FILE = "config.yaml"
MAX_CONFIG_BYTES = 1_000_000

_BEGIN, _END = "# Configuration of a run of wildgs", "# End of the configuration"
"""First and last line, to detect truncation: a truncated file could still be valid YAML with entries missing."""
_MOVED = (("data", "image_cache"), ("train", "cuda_graphs"))
"""Entries of earlier versions' `config.yaml` that are part of `ExecutionConfig` now."""


class _Loader(yaml.SafeLoader):
    """Loads plain data and rejects aliases, with which a small file can expand beyond the memory."""

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            event = self.peek_event()
            raise yaml.composer.ComposerError(None, None, "references are not allowed", event.start_mark)
        return super().compose_node(parent, index)


def write_config(path: Path, config: RunConfig) -> None:
    """Writes YAML atomically.

    Raises:
        UserError: The file cannot be written.
    """
    with written_aside(path, flush=True) as aside, aside.open("w", encoding="utf-8") as file:
        file.write(config_text(config))


def config_text(config: RunConfig) -> str:
    """The content of the file."""
    return f"{_BEGIN}\n{yaml.safe_dump(to_plain(config), sort_keys=False)}{_END}\n"


def read_config(path: Path) -> RunConfig:
    """Reads YAML.

    Raises:
        UserError: The file is missing, not YAML, or not the configuration of a run.
    """
    try:
        check_regular(path)
        if path.stat().st_size > MAX_CONFIG_BYTES:
            raise UserError(
                f"{path} is larger than {MAX_CONFIG_BYTES} bytes; it is not a run's configuration"
            )
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise UserError(
            f"{path.parent} contains no run: {path.name} is missing; give another folder, or train without --resume"
        ) from error
    except (OSError, ValueError) as error:
        raise _unreadable(str(path), error) from error
    return parse_config(text, str(path))


def parse_config(text: str, origin: str) -> RunConfig:
    """Parses the content of the file.

    Args:
        text: YAML.
        origin: Where it comes from, for messages.

    Raises:
        UserError: It is not YAML, or not the configuration of a run.
    """
    if text.startswith(_BEGIN) and _END not in text.splitlines():
        raise UserError(f"{origin} is truncated: the line {_END!r} is missing; restore it from a copy")
    try:
        plain = yaml.load(text, _Loader)
    except (ValueError, RecursionError, yaml.YAMLError) as error:  # ValueError: an invalid date
        raise _unreadable(origin, error) from error
    for part, name in _MOVED:
        if isinstance(plain, dict) and isinstance(plain.get(part), dict):
            plain[part].pop(name, None)
    return from_plain(RunConfig, plain, origin)


def _unreadable(origin: str, error: Exception) -> UserError:
    return UserError(f"{origin} cannot be read as a run's configuration: {error}".splitlines()[0])
