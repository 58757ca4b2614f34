"""Closed standard streams, as cron and daemons leave them, and signals after late imports."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="needs a POSIX shell")
CLOSED = (">&-", "2>&-", "<&- >&- 2>&-")


def run_closed(closed: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    """Runs Python with some of its standard streams closed."""
    command = ["sh", "-c", f'exec "$0" "$@" {closed}', sys.executable, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.mark.parametrize("closed", CLOSED)
def test_closed_streams_change_no_exit_code(closed: str, tmp_path: Path) -> None:
    done = run_closed(closed, "-m", "wildgs", "--version")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("wildgs") is (closed == "2>&-")
    assert run_closed(closed, "-m", "wildgs", "eval", tmp_path / "nowhere").returncode == 2


@pytest.mark.parametrize("closed", CLOSED)
def test_no_file_takes_the_place_of_a_closed_stream(closed: str, tmp_path: Path) -> None:
    code = (
        "import os, sys\nfrom wildgs.cli.streams import prepare_streams\nprepare_streams()\n"
        "file = open(sys.argv[1], 'w')\n"
        "for number in (1, 2):\n    os.write(number, b'a line of a C library')\n"
        "print('x', flush=True)\nassert sys.stdin.read() == ''\n"
    )
    done = run_closed(closed, "-W", "ignore", "-c", code, tmp_path / "file")
    assert done.returncode == 0
    assert (tmp_path / "file").read_bytes() == b""


@pytest.mark.parametrize(("verb", "arguments"), [("gallery", ["run", "--output", "g.png"]), ("doctor", [])])
def test_sigterm_after_pycolmap_was_imported_by_the_work(
    verb: str, arguments: list[str], tmp_path: Path
) -> None:
    """In a process of its own: here, other tests have imported pycolmap before."""
    code = (
        "import importlib, os, signal, sys, time\nfrom pathlib import Path\n"
        f"import wildgs.cli.{verb}\nfrom wildgs.cli import main\nfrom wildgs.files import written_aside\n"
        "def work(_):\n"
        "    importlib.import_module('pycolmap')\n"
        "    with written_aside(Path(sys.argv[1]) / 'file'):\n"
        "        os.kill(os.getpid(), signal.SIGTERM)\n        time.sleep(5)\n"
        f"wildgs.cli.{verb}.run = work\nmain({[verb, *arguments]})\n"
    )
    command = [sys.executable, "-c", code, str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (143, "terminated\n")
    assert list(tmp_path.iterdir()) == []
