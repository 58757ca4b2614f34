"""Checkpoints: safetensors with the run's configuration as JSON, written aside and renamed."""

from __future__ import annotations

import json
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from wildgs.errors import UserError

KEPT = 2
_NAME = re.compile(r"step_(\d{8})\.safetensors")


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


def save_checkpoint(folder: Path, step: int, state: dict[str, Tensor], header: dict[str, Any]) -> Path:
    """Writes ``step_NNNNNNNN.safetensors`` into a folder; the last two are kept.

    A reader never sees half a file: it is written under another name, flushed to disk, and renamed.

    Args:
        folder: Created where it is missing.
        step: Names the file.
        state: Flat tensors.
        header: JSON values.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"step_{step:08d}.safetensors"
    aside = path.with_suffix(".partial")
    tensors = {name: value.detach().cpu().contiguous() for name, value in state.items()}
    save_file(tensors, aside, metadata={"wildgs": json.dumps(header)})
    with aside.open("rb") as file:
        os.fsync(file.fileno())
    aside.replace(path)
    for old in list_checkpoints(folder)[:-KEPT]:
        old.unlink()
    return path


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
            header = json.loads((file.metadata() or {})["wildgs"])
            # Copies, since tensors in the file lie at any address, and sums depend on alignment to the last bit.
            state = {name: file.get_tensor(name).clone() for name in file.keys()}  # noqa: SIM118 - not a dict
    except (OSError, SafetensorError, KeyError, ValueError) as error:
        raise UserError(f"{path} is not a readable checkpoint ({error}); use another one") from error
    return Checkpoint(state, header)
