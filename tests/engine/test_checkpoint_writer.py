"""Checkpoints that a thread writes hold what they were given, and tell when they could not be written."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest
import torch

from wildgs.engine import autosave
from wildgs.engine.autosave import CheckpointWriter
from wildgs.engine.checkpoint import list_checkpoints, load_checkpoint
from wildgs.errors import UserError


def test_what_training_changes_meanwhile_is_not_in_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    save, go = autosave.save_checkpoint, threading.Event()
    monkeypatch.setattr(autosave, "save_checkpoint", lambda *given: go.wait(20) and save(*given))
    writer = CheckpointWriter(background=True)
    values = torch.zeros(3)
    writer.save(tmp_path, 7, {"values": values}, {"a": 1})
    assert list_checkpoints(tmp_path) == [], "training waited for the disk"
    values += 1
    go.set()
    writer.save(tmp_path, 8, {"values": values, "grown": torch.zeros(2)}, {})
    writer.wait()
    first, second = map(load_checkpoint, list_checkpoints(tmp_path))
    assert first.state["values"].tolist() == [0, 0, 0]
    assert first.header == {"a": 1}
    assert second.state["values"].tolist() == [1, 1, 1]


@pytest.mark.parametrize("background", [False, True])
def test_a_checkpoint_that_cannot_be_written_is_reported(tmp_path: Path, background: bool):
    blocked = tmp_path / "file"
    blocked.write_text("in the way")
    writer = CheckpointWriter(background)

    def save_and_wait() -> None:
        writer.save(blocked, 1, {"values": torch.zeros(1)}, {})
        writer.wait()

    with pytest.raises(UserError, match="cannot be written"):
        save_and_wait()
    writer.wait()
    writer.save(tmp_path, 2, {"values": torch.zeros(1)}, {})
    writer.wait()
    assert len(list_checkpoints(tmp_path)) == 1
