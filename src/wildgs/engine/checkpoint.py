"""Checkpoints: safetensors with a JSON header and a checksum, written aside, flushed, renamed."""

from __future__ import annotations

import hashlib
import json
import os
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

KEPT = 2
DAMAGED = ".damaged"
_NAME = re.compile(r"step_(\d{8})\.safetensors")
_TIMINGS = ("progress.seconds",)
"""Tensors that differ between two equal runs."""


@dataclass(frozen=True)
class Checkpoint:
    """A read checkpoint.

    Attributes:
        state: What `Trainer.state` gave.
        header: What the caller stored beside it: JSON values.
    """

    state: dict[str, Tensor]
    header: dict[str, Any]

    @property
    def method(self) -> dict[str, Tensor]:
        """The method's own tensors."""
        prefix = "method."
        return {k.removeprefix(prefix): v for k, v in self.state.items() if k.startswith(prefix)}

    @property
    def fingerprint(self) -> str:
        """SHA-256 of all tensors but timings: the same for runs that computed the same."""
        return _digest({k: v for k, v in self.state.items() if k not in _TIMINGS}, "")


def save_checkpoint(folder: Path, step: int, state: dict[str, Tensor], header: dict[str, Any]) -> Path:
    """Writes ``step_NNNNNNNN.safetensors`` into a folder; the last two are kept.

    A reader never sees half a file: it is written under another name, flushed to disk, and renamed, and the
    folder is flushed. Whatever stops this leaves the checkpoints that were there before.

    Args:
        folder: Created where it is missing.
        step: Names the file.
        state: Flat tensors.
        header: JSON values.

    Raises:
        UserError: The disk is full, or the folder cannot be written to.
    """
    path = folder / f"step_{step:08d}.safetensors"
    aside = path.with_suffix(".partial")
    tensors = {name: value.detach().cpu().contiguous() for name, value in state.items()}
    text = json.dumps(header)
    metadata = {"wildgs": text, "sha256": _digest(tensors, text)}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for stale in folder.glob("*.partial"):
            stale.unlink()
        try:
            save_file(tensors, aside, metadata=metadata)
            _flush(aside)
            aside.replace(path)
        except BaseException:
            aside.unlink(missing_ok=True)
            raise
        _flush(folder)
        for old in list_checkpoints(folder)[:-KEPT]:
            old.unlink()
    except (OSError, SafetensorError) as error:
        raise UserError(
            f"{path} cannot be written ({error}); checkpoints from before are kept: make room, then --resume"
        ) from error
    return path


def _flush(path: Path) -> None:
    """Asks the system to bring a file or a folder's entries to the disk."""
    if path.is_dir() and os.name == "nt":  # folders cannot be opened there
        return
    handle = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


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
    """Reads a checkpoint.

    Raises:
        UserError: The file is missing, damaged, or no checkpoint.
    """
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            # Copies, since tensors in the file lie at any address, and sums depend on alignment to the last bit.
            state = {name: file.get_tensor(name).clone() for name in file.keys()}  # noqa: SIM118 - not a dict
        header = json.loads(metadata["wildgs"])
        if not isinstance(header, dict):
            raise ValueError("its header is no mapping")
        if "sha256" not in metadata:  # damage may hit the checksum's own name
            raise ValueError("it has no checksum")
        if metadata["sha256"] != _digest(state, metadata["wildgs"]):
            raise ValueError("its checksum does not match")
    except (OSError, SafetensorError, KeyError, ValueError, RuntimeError) as error:
        raise UserError(f"{path} is not a readable checkpoint ({error}); use another one") from error
    return Checkpoint(state, header)


def load_newest(folder: Path, *, set_aside: bool = False) -> Checkpoint | None:
    """The newest checkpoint that is whole, or None where there is none at all.

    Damaged ones are named in a warning, and the one before is taken.

    Args:
        folder: Where `save_checkpoint` wrote.
        set_aside: Whether to rename damaged ones, so that they do not count among the two that are kept.

    Raises:
        UserError: There are checkpoints, and all are damaged.
    """
    paths = list_checkpoints(folder)[::-1]
    for path in paths:
        try:
            return load_checkpoint(path)
        except UserError as error:
            reason = str(error.__cause__ or error)
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
            f"{folder}: no checkpoint is whole; the run has to start anew, in another --output (or delete them)"
        )
    return None
