"""Help: instant, short, and complete where all of it is asked for."""

from __future__ import annotations

import subprocess
import sys

import pytest

from wildgs.cli import VERBS

HEAVY = ("torch", "numba", "scipy", "pycolmap", "transformers", "viser")


def test_no_help_imports_what_only_work_needs() -> None:
    code = (
        "import sys\nfrom wildgs.cli import main\n"
        f"for verb in {list(VERBS)}:\n"
        "    for option in ('--help', '--help-all'):\n"
        "        try:\n            main([verb, option])\n        except SystemExit as end:\n"
        "            assert not end.code, verb\n"
        f"        assert not set(sys.modules) & set({HEAVY}), (verb, option)\n"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr


def test_help_shows_what_matters_and_says_where_the_rest_is(wildgs, capsys) -> None:
    assert wildgs("train", "--help") == 0
    brief = capsys.readouterr().out
    for option in ("--output", "--steps", "--downscale", "--preset", "--resume", "--max-gaussians"):
        assert option in brief, option
    assert "--optimizer.means" not in brief
    assert "`wildgs train --help-all` shows all" in brief
    assert wildgs("train", "--help-all") == 0
    whole = capsys.readouterr().out
    assert "--optimizer.means" in whole
    assert "--checkpoint-minutes" in whole


@pytest.mark.parametrize("preset", ["default", "paper"])
def test_help_shows_the_presets_defaults(preset: str, wildgs, capsys) -> None:
    assert wildgs("train", "--preset", preset, "--help-all") == 0
    text = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert ("(default: 3)" in text.split("--fusion.sh-degree")[1][:200]) is (preset == "paper")
