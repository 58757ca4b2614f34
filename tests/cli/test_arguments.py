"""What is refused before a command begins, and help on a terminal of a few columns."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from wildgs.cli.arguments import refuse_repeated
from wildgs.cli.bench import REPEATABLE
from wildgs.errors import UserError


@pytest.mark.parametrize(
    "arguments",
    [
        "s0 --without mask --without depth",
        "r0 --format ply --format=spz",
        "--max-side 3 s0 --max_side 4",
        "--aligned --no-aligned",
        "--density.no-revise --density.revise",
        "--density.no_revise --density.no-revise",
    ],
)
def test_an_option_is_given_once(arguments: str) -> None:
    with pytest.raises(UserError, match=r"give it once|give one of them"):
        refuse_repeated(arguments.split())


@pytest.mark.parametrize(
    "arguments",
    [
        "s0 --without mask depth --appearance a --like a",
        "--sky.points 3 --points 3",
        "--steps 3 -- --steps --steps",
        "s0 --variant a:b=1 --steps 4 --variant c:d=2",
        "x -1 -1 - -",
    ],
)
def test_different_options_pass(arguments: str) -> None:
    refuse_repeated(arguments.split(), REPEATABLE)


def test_a_repeated_option_is_refused_by_name(wildgs, tmp_path: Path, capsys) -> None:
    assert wildgs("eval", tmp_path, "--protocol", "full", "--protocol", "half") == 2
    assert (
        capsys.readouterr().err
        == "error: --protocol is given twice; give it once, followed by all its values\n"
    )


def test_variants_of_a_benchmark_add_up(wildgs, tmp_path: Path, capsys) -> None:
    variants = ("--variant", "a:model.x=1", "--variant", "b:model.x=2")
    assert wildgs("bench", tmp_path / "nowhere", "--output", tmp_path / "out", *variants) == 2
    assert "twice" not in capsys.readouterr().err


@pytest.mark.skipif(sys.platform == "win32", reason="Windows does not delete the current folder")
def test_a_deleted_current_folder(wildgs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    gone = tmp_path / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    assert wildgs("eval", tmp_path) == 2
    assert capsys.readouterr().err == (
        "error: the current folder does not exist any more; change to another one\n"
    )


@pytest.mark.parametrize("arguments", [("--help",), ("--no-such-option",)])
def test_help_on_few_columns(arguments: tuple[str, ...]) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "wildgs", "eval", *arguments],
        env=os.environ | {"COLUMNS": "5"},
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    assert done.returncode == (0 if arguments == ("--help",) else 2)
    assert max(map(len, (done.stdout + done.stderr).splitlines())) >= 38
