"""Checkpoints: damage of any kind is found, the one before is used, and a full disk costs nothing."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from wildgs.engine.checkpoint import (
    DamagedCheckpointError,
    list_checkpoints,
    load_checkpoint,
    load_header,
    load_newest,
    save_checkpoint,
)
from wildgs.errors import UserError, WildGSWarning

STATE = {
    "x": torch.arange(12, dtype=torch.float32).reshape(3, 4),
    "step": torch.tensor(7),
    "half": torch.ones(3, dtype=torch.bfloat16),
    "nothing": torch.zeros(0, 3),
    "progress.seconds": torch.tensor(1.5),
}


def save(folder: Path, *steps: int) -> list[Path]:
    for step in steps:
        save_checkpoint(folder, step, STATE | {"step": torch.tensor(step)}, {"note": "ä"})
    return list_checkpoints(folder)


def test_the_last_two_are_kept(tmp_path: Path) -> None:
    kept = save(tmp_path, 1, 2, 3)
    assert [path.name for path in kept] == ["step_00000002.safetensors", "step_00000003.safetensors"]
    assert sorted(tmp_path.iterdir()) == kept, "nothing half written"
    checkpoint = load_checkpoint(kept[-1])
    assert checkpoint.header == {"note": "ä"}
    assert all(torch.equal(checkpoint.state[name], STATE[name]) for name in STATE if name != "step")


def test_fingerprint_knows_every_tensor_but_no_clock(tmp_path: Path) -> None:
    (path,) = save(tmp_path, 7)
    first = load_checkpoint(path).fingerprint
    save_checkpoint(tmp_path, 7, STATE | {"progress.seconds": torch.tensor(9.0)}, {"note": "other"})
    assert load_checkpoint(path).fingerprint == first
    save_checkpoint(tmp_path, 7, STATE | {"x": STATE["x"] + 1}, {"note": "ä"})
    assert load_checkpoint(path).fingerprint != first


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    (path,) = save(tmp_path_factory.mktemp("whole"), 7)
    return path.read_bytes()


@given(st.data())
@settings(max_examples=300, deadline=None)
def test_no_flipped_bit_goes_unseen(whole: bytes, tmp_path_factory, data: st.DataObject) -> None:
    position = data.draw(st.integers(0, len(whole) * 8 - 1))
    path = tmp_path_factory.getbasetemp() / "flipped.safetensors"
    flipped = bytearray(whole)
    flipped[position // 8] ^= 1 << position % 8
    path.write_bytes(flipped)
    try:
        checkpoint = load_checkpoint(path)
    except DamagedCheckpointError:
        return
    assert checkpoint.header == {"note": "ä"}, (
        "only a bit that says nothing may pass (the checksum's own name)"
    )
    assert all(torch.equal(checkpoint.state[name], STATE[name]) for name in STATE)


@given(st.integers(0, 10_000))
@settings(max_examples=100, deadline=None)
def test_no_truncation_goes_unseen(whole: bytes, tmp_path_factory, keep: int) -> None:
    path = tmp_path_factory.getbasetemp() / "short.safetensors"
    path.write_bytes(whole[: keep % len(whole)])
    with pytest.raises(DamagedCheckpointError, match="damaged"):
        load_checkpoint(path)


@pytest.mark.parametrize("damage", ["truncated", "flipped", "empty", "other file"])
def test_the_one_before_a_damaged_one_is_used(tmp_path: Path, damage: str) -> None:
    older, newer = save(tmp_path, 1, 2)
    content = bytearray(newer.read_bytes())
    content[-3] ^= 4
    spoiled = {"truncated": content[:-10], "flipped": content, "empty": b"", "other file": b"\x80\x04pickle."}
    newer.write_bytes(spoiled[damage])
    with pytest.warns(
        WildGSWarning, match=r"step_00000002\.safetensors is damaged .*the checkpoint before it"
    ):
        checkpoint = load_newest(tmp_path)
    assert checkpoint is not None
    assert int(checkpoint.state["step"]) == 1
    assert newer.exists(), "a reader leaves it where it is"
    with pytest.warns(WildGSWarning, match="damaged"):
        load_newest(tmp_path, set_aside=True)
    assert list_checkpoints(tmp_path) == [older]
    assert len(save(tmp_path, 3)) == 2, "the damaged one is not among the two that are kept"


def test_all_damaged_is_a_users_mistake_and_none_is_none(tmp_path: Path) -> None:
    assert load_newest(tmp_path) is None
    for path in save(tmp_path, 1, 2):
        path.write_bytes(b"")
    with (
        pytest.warns(WildGSWarning, match="step_00000002"),
        pytest.raises(UserError, match="all checkpoints are damaged"),
    ):
        load_newest(tmp_path)


def test_damage_to_the_checksums_own_name_is_seen(whole: bytes, tmp_path: Path) -> None:
    path = tmp_path / "step_00000001.safetensors"
    path.write_bytes(whole.replace(b"sha256", b"sha257").replace(b'"x"', b'"y"'))
    with pytest.raises(UserError, match="its header is incomplete"):
        load_checkpoint(path)


def test_what_a_killed_writer_left_is_cleared(tmp_path: Path) -> None:
    (tmp_path / ".step_00000001.safetensors.123.part").write_bytes(b"half")
    kept = save(tmp_path, 2)
    assert list(tmp_path.iterdir()) == kept


@pytest.mark.parametrize("where", ["wildgs.engine.checkpoint.save_file", "wildgs.files._flush"])
def test_a_failed_write_leaves_the_old_ones(tmp_path: Path, monkeypatch, where: str) -> None:
    kept = save(tmp_path, 1, 2)

    def fail(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(where, fail)
    with pytest.raises(UserError, match=r"cannot be written .*No space left.*free disk space"):
        save(tmp_path, 3)
    assert sorted(tmp_path.iterdir()) == kept
    monkeypatch.undo()
    assert int(load_newest(tmp_path).state["step"]) == 2  # pyright: ignore[reportOptionalMemberAccess]


def test_ctrl_c_while_writing_leaves_nothing_half(tmp_path: Path, monkeypatch) -> None:
    kept = save(tmp_path, 1)

    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("wildgs.files._flush", interrupt)
    with pytest.raises(KeyboardInterrupt):
        save(tmp_path, 2)
    assert sorted(tmp_path.iterdir()) == kept


def test_a_full_disk_costs_no_checkpoint(small_disk: Path) -> None:
    state = {"x": torch.rand(400_000)}
    save_checkpoint(small_disk, 1, state, {})
    save_checkpoint(small_disk, 2, state, {})
    with pytest.raises(UserError, match="step_00000003"):
        save_checkpoint(small_disk, 3, state, {})
    newest = load_newest(small_disk)
    assert newest is not None
    assert torch.equal(newest.state["x"], state["x"])
    assert [path.name for path in small_disk.iterdir() if ".part" in path.name] == []
    list_checkpoints(small_disk)[0].unlink()
    save_checkpoint(small_disk, 3, state, {})
    assert len(list_checkpoints(small_disk)) == 2


@pytest.mark.parametrize("error", [MemoryError("no memory"), RuntimeError("no memory"), OSError(13, "no")])
def test_what_cannot_be_read_for_another_reason_is_not_called_damaged(
    tmp_path: Path, monkeypatch, error: Exception
) -> None:
    kept = save(tmp_path, 1, 2)

    def fail(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr("wildgs.engine.checkpoint.safe_open", fail)
    with pytest.raises(UserError, match=r"step_00000002.* cannot be read .*the file was not changed"):
        load_newest(tmp_path, set_aside=True)
    assert list_checkpoints(tmp_path) == kept


@pytest.mark.skipif(os.name == "nt", reason="Windows has no umask")
def test_a_checkpoint_has_the_permissions_of_any_new_file(tmp_path: Path) -> None:
    (path,) = save(tmp_path, 1)
    other = tmp_path / "other"
    other.write_bytes(b"")
    assert path.stat().st_mode == other.stat().st_mode


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes here")
def test_a_pipe_in_the_place_of_a_checkpoint_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "step_00000003.safetensors")
    with pytest.raises(UserError, match="not a regular file"):
        load_newest(tmp_path)
    assert load_header(tmp_path / "step_00000003.safetensors") == {}
