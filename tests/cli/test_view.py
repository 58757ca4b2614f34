"""`wildgs view` and `wildgs train --view`: mistakes in one line, and training that is not disturbed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("viser", reason="the extra 'viewer' is not installed")

TINY = (
    "--steps", 4, "--wrapping.resolution", 16, "--parsing.max-side", 32, "--parsing.encoder", "nobody/none"
)  # fmt: skip


@pytest.fixture
def left_open(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Viewers that were left open for people; Ctrl-C comes at once, when all work is done."""
    from wildgs.viewer.serving import OpenViewer

    opened: list[Any] = []

    def stay(page: OpenViewer) -> None:
        opened.append(page.viewer)
        while (job := page.viewer.jobs.take(wait=False)) is not None:
            job()
        page.viewer.close()

    monkeypatch.setattr(OpenViewer, "stay", stay)
    return opened


def complaint(capsys: pytest.CaptureFixture[str]) -> str:
    lines = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("warning:")]
    assert len(lines) == 1, lines
    return lines[0]


def test_view_opens_the_run_and_says_where(trained: Path, wildgs, left_open: list[Any], capsys) -> None:
    assert wildgs("view", trained, "--port", 0) == 0
    (viewer,) = left_open
    address = f"http://127.0.0.1:{viewer.server.get_port()}/{viewer.server.access.token}/"
    assert any(line.endswith(address) for line in capsys.readouterr().out.splitlines()), (
        "on one line, to copy"
    )
    assert len(viewer.display._handle.centers) == len(viewer.subject.method.gaussians)
    assert viewer.recording.folder == trained / "videos"


def test_view_begins_with_the_lights_asked_for(
    trained: Path, landmark: Path, wildgs, left_open: list[Any]
) -> None:
    names = sorted(path.name for path in (landmark / "images").iterdir())
    assert wildgs("view", trained, "--port", 0, "--appearance", names[3], names[1]) == 0
    desk = left_open[0].lighting.desk
    assert (desk.first.spec, desk.second.spec) == (names[3], names[1])


def test_train_shows_itself_and_ends_as_ever(
    landmark: Path, tmp_path: Path, wildgs, left_open: list[Any], capsys
) -> None:
    assert wildgs("train", landmark, "--output", tmp_path / "run", "--view", "--server.port", 0, *TINY) == 0
    assert [path.name for path in (tmp_path / "run" / "checkpoints").iterdir()] == [
        "step_00000004.safetensors"
    ]
    assert f"/{left_open[0].server.access.token}/" in capsys.readouterr().out
    assert left_open[0].recording.folder is None, "no videos while it trains"
    assert "trained 4 steps" in left_open[0]._status.content


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_signals_leave_no_temporary_folder(trained: Path, tmp_path: Path, number: int) -> None:
    """Uploaded pictures lie in one while the viewer is open."""
    command = [sys.executable, "-m", "wildgs", "view", str(trained), "--port", "0"]
    environment = os.environ | {"TMPDIR": str(tmp_path)}
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
    ) as viewer:
        assert viewer.stdout is not None
        assert any("Ctrl-C ends" in line for line in viewer.stdout)
        assert [path.name[:12] for path in tmp_path.iterdir()] == ["wildgs-view-"]
        viewer.send_signal(number)
        _, error = viewer.communicate(timeout=120)
    assert viewer.returncode == 128 + number
    assert "***" not in error
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("view", "{tmp}"), "not a run folder"),
        (("view", "{run}", "--host", "192.0.2.1"), "--host 192.0.2.1"),
        (("view", "{run}", "--appearance", "a", "b", "c", "--port", "0"), "one or two"),
    ],
)
def test_mistakes_are_one_line(
    arguments: tuple[str, ...], message: str, trained: Path, wildgs, tmp_path: Path, capsys
) -> None:
    capsys.readouterr()
    assert wildgs(*(a.format(tmp=tmp_path, run=trained) for a in arguments)) == 2
    assert message in complaint(capsys)


@pytest.mark.parametrize("verb", ["view", "train"])
def test_without_viser_it_says_how_to_get_it(
    verb: str, trained: Path, landmark: Path, wildgs, tmp_path: Path, capsys, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    capsys.readouterr()
    arguments = (
        ("view", trained) if verb == "view" else ("train", landmark, "--output", tmp_path / "r", "--view")
    )
    assert wildgs(*arguments) == 2
    assert "pip install 'wildgs[viewer]'" in complaint(capsys)
    assert not (tmp_path / "r").exists()
