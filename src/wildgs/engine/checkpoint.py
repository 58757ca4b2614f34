"""Checkpoints: safetensors with a JSON header and a checksum, written atomically."""

from __future__ import annotations

import errno
import hashlib
import json
import re
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from wildgs.errors import UserError, WildGSWarning
from wildgs.files import check_regular, remove_leftovers, written_aside

KEPT = 2
DAMAGED = ".damaged"
_NAME = re.compile(r"step_(\d{8})\.safetensors")
_TIMINGS = ("progress.seconds",)
"""Tensors that differ between otherwise identical runs."""


@dataclass(frozen=True)
class Checkpoint:
    """A loaded checkpoint: the result of `Trainer.state`, and a header of JSON values."""

    state: dict[str, Tensor]
    header: dict[str, Any]

    @property
    def method(self) -> dict[str, Tensor]:
        """The method's own tensors."""
        prefix = "method."
        return {k.removeprefix(prefix): v for k, v in self.state.items() if k.startswith(prefix)}

    @property
    def fingerprint(self) -> str:
        """SHA-256 of all tensors except timings, for comparing runs."""
        return _digest({k: v for k, v in self.state.items() if k not in _TIMINGS}, "")


class DamagedCheckpointError(UserError):
    """A checkpoint is truncated or its content has changed."""


def save_checkpoint(folder: Path, step: int, state: dict[str, Tensor], header: dict[str, Any]) -> Path:
    """Writes ``step_NNNNNNNN.safetensors`` atomically, flushes it to the disk and deletes all but the last two.

    A failure does not affect earlier checkpoints. The header holds JSON values.

    Raises:
        UserError: The file cannot be written.
    """
    path = folder / f"step_{step:08d}.safetensors"
    tensors = {name: value.detach().cpu().contiguous() for name, value in state.items()}
    text = json.dumps(header)
    metadata = {"wildgs": text, "sha256": _digest(tensors, text)}
    try:
        remove_leftovers(folder)
        with written_aside(path, flush=True) as aside:
            try:
                save_file(tensors, aside, metadata=metadata)
            except SafetensorError as error:  # raised on a full disk
                raise OSError(error) from error
        for old in list_checkpoints(folder)[:-KEPT]:
            old.unlink()
    except (OSError, UserError) as error:
        raise UserError(
            f"{path} cannot be written ({error.__cause__ or error}); earlier checkpoints are kept: "
            "free disk space or fix permissions, then --resume"
        ) from error
    return path


def _digest(tensors: dict[str, Tensor], header: str) -> str:
    """SHA-256 over the header and every tensor's name, type, shape and bytes."""
    digest = hashlib.sha256(header.encode())
    for name in sorted(tensors):
        tensor = tensors[name].detach().cpu().contiguous()
        digest.update(f"\n{name} {tensor.dtype} {tuple(tensor.shape)}\n".encode())
        digest.update(tensor.reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()


def list_checkpoints(folder: Path) -> list[Path]:
    """Checkpoints in a folder, oldest first."""
    if not folder.is_dir():
        return []
    return sorted(path for path in folder.iterdir() if _NAME.fullmatch(path.name))


def load_checkpoint(path: Path) -> Checkpoint:
    """Reads a checkpoint and verifies its checksum.

    Raises:
        DamagedCheckpointError: The file is damaged.
        UserError: The file is missing, or cannot be read for another reason (permissions, memory).
    """
    try:
        check_regular(path)
        with path.open("rb"):  # raises OSError if permissions are missing
            pass
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            # Cloned for memory alignment, on which the last bit of sums depends.
            state = {name: file.get_tensor(name).clone() for name in file.keys()}  # noqa: SIM118 - not a dict
        return Checkpoint(state, _checked_header(metadata, state))
    except (_DamageError, SafetensorError) as error:
        if "os error" in str(error):
            raise UserError(f"{path} cannot be read ({error}); {_NOT_DAMAGED}") from error
        raise DamagedCheckpointError(f"{path} is damaged ({error}); use another checkpoint") from error
    except (OSError, MemoryError, RuntimeError) as error:  # torch reports missing memory as a RuntimeError
        if getattr(error, "errno", None) == errno.ELOOP:
            raise DamagedCheckpointError(f"{path} is a link to itself; use another checkpoint") from error
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise UserError(f"{path} cannot be read ({reason}); {_NOT_DAMAGED}") from error


def load_header(path: Path) -> dict[str, Any]:
    """The header of a checkpoint, without tensors and checksum; empty if it cannot be read."""
    try:
        check_regular(path)
        with safe_open(path, framework="pt") as file:
            header = json.loads((file.metadata() or {}).get("wildgs", "{}"))
    except (OSError, SafetensorError, ValueError, RecursionError):
        return {}
    return header if isinstance(header, dict) else {}


_NOT_DAMAGED = "the file was not changed: free memory or fix permissions, then try again"


class _DamageError(Exception):
    """A checkpoint's header or checksum is invalid."""


def _checked_header(metadata: dict[str, str], state: dict[str, Tensor]) -> dict[str, Any]:
    """The header of a checkpoint, after verifying its checksum."""
    try:
        text, checksum = metadata["wildgs"], metadata["sha256"]
        header = json.loads(text)
    except (KeyError, ValueError, RecursionError) as error:
        raise _DamageError(f"its header is incomplete: {error}") from error
    if not isinstance(header, dict):
        raise _DamageError("its header is not a mapping")
    if checksum != _digest(state, text):
        raise _DamageError("its checksum does not match")
    return header


def load_newest(folder: Path, *, set_aside: bool = False) -> Checkpoint | None:
    """Loads the newest undamaged checkpoint; None if there are no checkpoints.

    Warns of damaged ones and loads the previous one instead. With `set_aside`, damaged files are renamed, so that
    they do not count as one of the two that are kept.

    Raises:
        UserError: All checkpoints are damaged, or the newest cannot be read for another reason.
    """
    paths = list_checkpoints(folder)[::-1]
    for path in paths:
        try:
            return load_checkpoint(path)
        except DamagedCheckpointError as error:
            reason = str(error.__cause__)
        if path != paths[-1]:
            warnings.warn(
                f"{path} is damaged ({reason}); going back to the checkpoint before it",
                WildGSWarning,
                stacklevel=2,
            )
            if set_aside:
                path.rename(path.with_name(path.name + DAMAGED))
    if paths:
        raise UserError(
            f"{folder}: all checkpoints are damaged; delete them to start again, or choose another --output"
        )
    return None
