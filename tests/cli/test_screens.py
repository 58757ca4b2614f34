"""Screens that go away: nothing that only shows progress ends a training, and a closed terminal saves it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from wildgs.cli import screen
from wildgs.engine.checkpoint import list_checkpoints
from wildgs.files import written_aside
from wildgs.runs import load_run

SOURCE = Path(__file__).parents[2] / "src"
TRAIN = ("--method", "3dgs", "--checkpoint-every", "1000")


def start(
    landmark: Path, run: Path, steps: int = 30, python: str | Path = sys.executable, **streams: object
) -> subprocess.Popen[bytes]:
    command = [python, "-m", "wildgs", "train", landmark, "--output", run, *TRAIN, "--steps", steps]
    environment = os.environ | {"PYTHONPATH": str(SOURCE), "WILDGS_NUM_THREADS": "1"}
    return subprocess.Popen([str(part) for part in command], env=environment, **streams)  # pyright: ignore


def trained_steps(run: Path) -> int:
    return load_run(run).step


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
def test_output_on_a_full_disk(forking_python: Path, landmark: Path, tmp_path: Path) -> None:
    with Path("/dev/full").open("wb") as full:
        process = start(landmark, tmp_path / "run", python=forking_python, stdout=full, stderr=full)
        assert process.wait() == 0
    assert trained_steps(tmp_path / "run") == 30


@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_a_reader_that_leaves(
    landmark: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, unbuffered: str
) -> None:
    monkeypatch.setenv("PYTHONUNBUFFERED", unbuffered)
    process = start(landmark, tmp_path / "run", stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert process.stdout is not None
    assert process.stderr is not None
    process.stdout.close()
    process.stderr.close()
    assert process.wait() == 0
    assert trained_steps(tmp_path / "run") == 30


def test_a_closed_terminal_saves(landmark: Path, tmp_path: Path) -> None:
    run, steps = tmp_path / "run", 100_000
    ours, theirs = os.openpty()
    process = start(landmark, run, steps, stdin=theirs, stdout=theirs, stderr=theirs, start_new_session=True)
    os.close(theirs)
    while not (run / "metrics.jsonl").is_file() or not (run / "metrics.jsonl").stat().st_size:
        assert process.poll() is None
        os.read(ours, 10_000)
        time.sleep(0.02)
    os.close(ours)  # the terminal is gone: writing to it fails from now on
    process.send_signal(signal.SIGHUP)
    assert process.wait() == 128 + signal.SIGHUP
    assert list_checkpoints(run / "checkpoints")
    assert 0 < trained_steps(run) < steps


def test_nohup_is_respected(landmark: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    process = start(
        landmark,
        run,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_IGN),
    )
    while process.poll() is None and not (run / "config.yaml").is_file():
        time.sleep(0.02)
    process.send_signal(signal.SIGHUP)
    assert process.wait() == 0
    assert trained_steps(run) == 30


def test_sigterm_ends_every_verb_in_one_line(
    wildgs, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """pycolmap, which comes with the scene, would print a C++ stack and leave temporary files."""
    before = signal.getsignal(signal.SIGTERM)

    def work(_: object) -> None:
        assert "pycolmap" in sys.modules
        assert signal.getsignal(signal.SIGTERM) not in (before, signal.SIG_DFL)
        with written_aside(tmp_path / "file"):
            signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr("wildgs.cli.gallery.run", work)
    assert wildgs("gallery", tmp_path, "--output", tmp_path / "g.png") == 128 + signal.SIGTERM
    assert capsys.readouterr().err == "terminated\n"
    assert list(tmp_path.iterdir()) == []
    assert signal.getsignal(signal.SIGTERM) == before


def test_names_are_printed_as_they_are(capsys: pytest.CaptureFixture[str]) -> None:
    screen.console.print("w[/b]/x.html :smile: [red]v2")
    with screen.progress_shown() as show:
        show("reading [b]photos[/b]", 2, 2)
    screen.print_scores({"evil [v2]": {}})
    printed = capsys.readouterr().out
    assert "w[/b]/x.html :smile: [red]v2" in printed
    assert "reading [b]photos[/b]: 2 done" in printed


def test_a_name_that_is_not_utf8_is_printed_with_escapes(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    with (tmp_path / "out").open("w", encoding="utf-8") as stream:
        monkeypatch.setattr(sys, "stdout", stream)
        screen.console.print(os.fsdecode(b"caf\xe9.jpg"))
    assert (tmp_path / "out").read_text() == "caf\\udce9.jpg\n"


def test_long_stages_print_a_line_a_minute_into_files(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    clock = [0.0]
    monkeypatch.setattr(screen.time, "monotonic", lambda: clock[0])
    with screen.progress_shown() as show:
        for done in range(8):
            clock[0] = 25.0 * done
            show("finding poses", done, 7)
    lines = capsys.readouterr().out.splitlines()
    assert lines == ["finding poses: 3 of 7", "finding poses: 6 of 7", "finding poses: 7 done"]
