"""The bug report: what helps is in it, names are not."""

from __future__ import annotations

import getpass
import socket
from pathlib import Path

import pytest

from wildgs.library import doctor as bug_report
from wildgs.library.doctor import without_names, write_report


@pytest.mark.parametrize(
    "text",
    [
        "/home/ada/photos/gate",
        "/Users/ada/photos/gate",
        "C:\\Users\\ada\\photos",
        "scene: /home/ada",
        "'/home/ada/x'",
    ],
)
def test_home_folders_lose_their_names(text: str) -> None:
    assert "ada" not in without_names(text)
    assert "~" in without_names(text)


def test_the_user_and_the_machine_are_not_named(monkeypatch) -> None:
    monkeypatch.setattr(getpass, "getuser", lambda: "ada")
    monkeypatch.setattr(socket, "gethostname", lambda: "lovelace-pc")
    monkeypatch.setattr(Path, "home", classmethod(lambda cls: Path("/data/people/ada")))
    text = without_names("/data/people/ada/x by ada@lovelace-pc, adaptive")
    assert text == "~/x by USER@HOST, adaptive"


def test_a_run_brings_its_configuration_and_last_lines(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text("scene: /home/ada/gate\n")
    (tmp_path / "train.log").write_text("".join(f"line {i}\n" for i in range(1000)))
    report = write_report([("Python", "works", "3.11 in /home/ada/venv")], tmp_path)
    assert "scene: ~/gate" in report
    assert "line 999" in report
    assert "line 10\n" not in report
    assert "- torch " in report
    assert "ada" not in report


def test_a_run_without_files_still_gives_a_report(tmp_path: Path) -> None:
    (tmp_path / "train.log").write_bytes(b"\xff\xfe broken \x00")
    report = write_report([], tmp_path / "nowhere")
    assert "cannot be read" in report
    assert bug_report.LOG_FILE
    assert "broken" in write_report([], tmp_path)


def test_the_doctor_prints_it(wildgs, tmp_path: Path, capsys, monkeypatch) -> None:
    from wildgs.library import doctor

    monkeypatch.setattr(doctor, "examine", lambda: [doctor.Check("Python", "works", "fine")])
    assert wildgs("doctor", "--report", "--run", tmp_path) == 0
    assert "- Python: works: fine" in capsys.readouterr().out
