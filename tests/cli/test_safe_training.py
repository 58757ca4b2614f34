"""Interrupting, locking, resuming and running out of memory, through the command line in this process."""

from __future__ import annotations

import json
import signal
import tempfile
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import yaml

from wildgs.config import RunConfig
from wildgs.config_file import read_config
from wildgs.engine import autosave
from wildgs.engine.checkpoint import list_checkpoints, load_checkpoint
from wildgs.engine.config import TrainConfig
from wildgs.engine.trainer import Trainer
from wildgs.errors import UserError, WildGSWarning
from wildgs.library.logs import InterruptedTrainingError, StopOnSignal
from wildgs.library.training import train
from wildgs.runs import load_run, lock_run

TRAIN = ("--method", "3dgs", "--steps", 24, "--checkpoint-every", 5)


def fingerprint(run: Path) -> str:
    return load_checkpoint(list_checkpoints(run / "checkpoints")[-1]).fingerprint


@pytest.fixture(scope="session")
def undisturbed(landmark: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    from wildgs.cli import main

    output = tmp_path_factory.mktemp("runs") / "undisturbed"
    main([str(a) for a in ("train", landmark, "--output", output, *TRAIN)])
    return output


def call_at_step(monkeypatch: pytest.MonkeyPatch, step: int, action) -> None:
    """Runs an action in the middle of a step, once."""
    forward, done = Trainer._forward, []

    def disturbed(self: Trainer, *arguments):
        result = forward(self, *arguments)
        if self.step == step and not done:
            done.append(True)
            action(self)
        return result

    monkeypatch.setattr(Trainer, "_forward", disturbed)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_first_signal_saves_and_resuming_ends_in_the_same_bits(
    undisturbed: Path, landmark: Path, tmp_path: Path, wildgs, monkeypatch, capsys, number: signal.Signals
) -> None:
    run = tmp_path / "run"
    before = signal.getsignal(number)
    call_at_step(monkeypatch, 12, lambda _: signal.raise_signal(number))
    assert wildgs("train", landmark, "--output", run, *TRAIN) == 128 + number
    assert "step 13, saved" in capsys.readouterr().err
    assert signal.getsignal(number) == before
    assert load_run(run).step == 13
    assert wildgs("train", landmark, "--output", run, "--resume") == 0
    assert fingerprint(run) == fingerprint(undisturbed)
    steps = [json.loads(line)["step"] for line in (run / "metrics.jsonl").read_text().splitlines()]
    assert steps == sorted(set(steps))


def test_the_second_stops_at_once_and_saves_nothing_half(
    landmark: Path, tmp_path: Path, wildgs, monkeypatch
) -> None:
    def twice(_: Trainer) -> None:
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)

    call_at_step(monkeypatch, 12, twice)
    assert wildgs("train", landmark, "--output", tmp_path / "run", *TRAIN) == 130
    assert load_run(tmp_path / "run").step == 10


def test_a_crash_in_a_step_saves_nothing_half(
    undisturbed: Path, landmark: Path, tmp_path: Path, wildgs, monkeypatch
) -> None:
    def crash(_: Trainer) -> None:
        raise ZeroDivisionError("somewhere deep")

    run = tmp_path / "run"
    call_at_step(monkeypatch, 12, crash)
    with pytest.raises(ZeroDivisionError):
        wildgs("train", landmark, "--output", run, *TRAIN)
    assert load_run(run).step == 10
    assert "somewhere deep" in (run / "train.log").read_text()
    assert wildgs("train", landmark, "--output", run, "--resume") == 0
    assert fingerprint(run) == fingerprint(undisturbed)


def test_killed_before_the_first_checkpoint_starts_again(
    undisturbed: Path, landmark: Path, tmp_path: Path, wildgs, monkeypatch
) -> None:
    run = tmp_path / "run"

    def crash(_: Trainer) -> None:
        raise ZeroDivisionError

    call_at_step(monkeypatch, 2, crash)
    with pytest.raises(ZeroDivisionError):
        wildgs("train", landmark, "--output", run, *TRAIN)
    assert not list_checkpoints(run / "checkpoints")
    assert wildgs("train", landmark, "--output", run, "--resume") == 0
    assert fingerprint(run) == fingerprint(undisturbed)


def test_a_damaged_newest_checkpoint_is_said_and_passed_over(
    undisturbed: Path, landmark: Path, tmp_path: Path, wildgs, monkeypatch, capsys
) -> None:
    run = tmp_path / "run"
    call_at_step(monkeypatch, 12, lambda _: signal.raise_signal(signal.SIGINT))
    assert wildgs("train", landmark, "--output", run, *TRAIN) == 130
    newest = list_checkpoints(run / "checkpoints")[-1]
    newest.write_bytes(newest.read_bytes()[:-5])
    capsys.readouterr()
    assert wildgs("train", landmark, "--output", run, "--resume") == 0
    assert "is damaged" in capsys.readouterr().err
    assert fingerprint(run) == fingerprint(undisturbed)
    assert newest.with_name(newest.name + ".damaged").exists()


def test_a_run_in_use_is_locked(undisturbed: Path, landmark: Path, tmp_path: Path, wildgs, capsys) -> None:
    with lock_run(tmp_path / "run"):
        assert wildgs("train", landmark, "--output", tmp_path / "run", *TRAIN) == 2
        assert "in use by another training" in capsys.readouterr().err
    with lock_run(undisturbed), pytest.raises(UserError, match="in use"), lock_run(undisturbed):
        pass
    assert load_run(undisturbed).step == 24, "reading is always allowed"


def test_a_failure_before_anything_is_written_leaves_no_folder(tmp_path: Path) -> None:
    new, existing, used = tmp_path / "new", tmp_path / "existing", tmp_path / "used"
    existing.mkdir()

    def fail(folder: Path) -> None:
        with lock_run(folder):
            if folder == used:
                (folder / "config.yaml").touch()
            raise UserError("no photos")

    for folder in (new, existing, used):
        with pytest.raises(UserError):
            fail(folder)
    assert not new.exists()
    assert list(existing.iterdir()) == []
    assert (used / "config.yaml").exists()


def test_a_disk_without_locks_is_said_and_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise NotImplementedError("no flock")

    monkeypatch.setattr("filelock.FileLock.acquire", refuse)
    with pytest.warns(WildGSWarning, match="file system without locks"), lock_run(tmp_path / "run"):
        (tmp_path / "run" / "file").touch()


def test_a_folder_that_cannot_be_written_is_said(landmark: Path, tmp_path: Path, wildgs, capsys) -> None:
    (tmp_path / "file").write_text("")
    assert wildgs("train", landmark, "--output", tmp_path / "file" / "run", *TRAIN) == 2
    assert "cannot be written" in capsys.readouterr().err


def test_a_disk_that_fills_up_costs_no_checkpoint_and_no_step(
    undisturbed: Path, landmark: Path, small_disk: Path, tmp_path: Path, wildgs, monkeypatch, capsys
) -> None:
    """A real file system without room for the last checkpoint; then somebody makes room."""
    size = list_checkpoints(undisturbed / "checkpoints")[0].stat().st_size
    (small_disk / "filler").write_bytes(bytes(4 * 2**20 - int(1.6 * size)))
    run = small_disk / "run"
    monkeypatch.setattr(autosave, "LAST_WAIT", 0.01)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    assert wildgs("train", landmark, "--output", run, *TRAIN) == 2
    errors = capsys.readouterr().err
    assert "step_00000024.safetensors cannot be written" in errors
    assert "then --resume" in errors.splitlines()[-1]
    kept = list_checkpoints(run / "checkpoints")
    assert 0 < load_checkpoint(kept[-1]).state["progress.step"] < 24
    (rescued,) = tmp_path.glob("wildgs-run-*/checkpoints/step_00000024.safetensors")
    assert str(rescued) in errors.splitlines()[-1]
    assert load_checkpoint(rescued).fingerprint == fingerprint(undisturbed)
    assert sorted((run / "checkpoints").iterdir()) == kept  # nothing half
    (small_disk / "filler").unlink()
    assert wildgs("train", landmark, "--output", run, "--resume") == 0
    assert fingerprint(run) == fingerprint(undisturbed)


def test_signals_in_other_threads_are_left_alone() -> None:
    import threading

    before = signal.getsignal(signal.SIGINT)
    seen = []

    def work() -> None:
        with StopOnSignal():
            seen.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [before]
    assert issubclass(InterruptedTrainingError, KeyboardInterrupt)


def out_of_memory(_: Trainer) -> None:
    raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB")


def test_memory_that_runs_out_is_tried_again_with_fewer(
    landmark: Path, tmp_path: Path, wildgs, monkeypatch, capsys
) -> None:
    run = tmp_path / "run"
    call_at_step(monkeypatch, 12, out_of_memory)
    assert wildgs("train", landmark, "--output", run, *TRAIN) == 0
    assert "out of memory; continuing from the newest checkpoint with at most" in capsys.readouterr().err
    loaded = load_run(run)
    budget = yaml.safe_load((run / "config.yaml").read_text())["train"]["density"]["max_gaussians"]
    assert loaded.step == 24
    assert loaded.method.num_gaussians <= budget < 3_000_000


def test_memory_that_runs_out_twice_is_a_users_mistake(
    landmark: Path, tmp_path: Path, wildgs, monkeypatch, capsys
) -> None:
    def forward(self: Trainer, *arguments):
        out_of_memory(self)

    monkeypatch.setattr(Trainer, "_forward", forward)
    assert wildgs("train", landmark, "--output", tmp_path / "run", *TRAIN) == 2
    assert "ran out of memory again" in capsys.readouterr().err


def test_a_budget_below_the_points_holds_from_the_start(
    landmark: Path, tmp_path: Path, wildgs, capsys
) -> None:
    assert wildgs("train", landmark, "--output", tmp_path / "run", *TRAIN, "--max-gaussians", 100) == 0
    assert "training starts from 75 of them" in capsys.readouterr().err
    assert load_run(tmp_path / "run").method.num_gaussians <= 100


def test_resuming_with_a_lower_budget_drops_the_faintest(
    landmark: Path, tmp_path: Path, wildgs, monkeypatch
) -> None:
    run = tmp_path / "run"
    call_at_step(monkeypatch, 12, lambda _: signal.raise_signal(signal.SIGINT))
    assert wildgs("train", landmark, "--output", run, *TRAIN) == 130
    before = load_run(run).method.gaussians.opacities
    assert (
        wildgs("train", landmark, "--output", run, "--resume", "--max-gaussians", 50, "--image-cache", "1MB")
        == 0
    )
    assert load_run(run).method.num_gaussians <= 50 < len(before)


def test_a_budget_that_cannot_fit_is_refused(
    landmark: Path, tmp_path: Path, wildgs, monkeypatch, capsys
) -> None:
    from wildgs.engine import memory

    monkeypatch.setattr(memory, "free_memory", lambda _: 2 * 10**9)
    assert wildgs("train", landmark, "--output", tmp_path / "a", *TRAIN, "--max-gaussians", 10**9) == 2
    assert "lower --max-gaussians to" in capsys.readouterr().err
    assert wildgs("train", landmark, "--output", tmp_path / "b", *TRAIN, "--max-gaussians", 0) == 2


def test_training_that_is_called_again_goes_on_with_the_same_configuration_only(
    landmark: Path, tmp_path: Path
) -> None:
    config = RunConfig(landmark, "3dgs", train=TrainConfig(steps=4))
    for _ in range(2):
        assert train(landmark, config, output=tmp_path, resume="auto").steps == 4
    assert read_config(tmp_path / "config.yaml").train.steps == 4
    with pytest.raises(UserError, match=r"train\.steps is 4, not 5"):
        train(landmark, replace(config, train=TrainConfig(steps=5)), output=tmp_path, resume="auto")
