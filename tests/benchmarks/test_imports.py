"""Benchmarks start as their docstrings say, `python benchmarks/NAME.py`, from any folder."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
FIND = (
    "import sys; from importlib.util import find_spec; print(*[m for m in sys.argv[1:] if not find_spec(m)])"
)


def imported_modules(script: Path) -> set[str]:
    """The top-level modules that a script imports, wherever in it."""
    nodes = list(ast.walk(ast.parse(script.read_text())))
    names = [alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names]
    names += [
        node.module for node in nodes if isinstance(node, ast.ImportFrom) and node.module and not node.level
    ]
    return {name.partition(".")[0] for name in names}


def test_modules_of_benchmarks_are_found_from_other_folders(tmp_path):
    scripts = sorted((ROOT / "benchmarks").glob("*.py"))
    beside = {script.stem for script in scripts}
    names = set[str]().union(*map(imported_modules, scripts)) - beside
    assert {"benchmarks", "demo_generator"} <= names
    # Packages of other environments (gsplat, LPIPS's own) may be absent; the repository's may not.
    ours = sorted(name for name in names if (ROOT / name).is_dir())
    found = subprocess.run(
        [sys.executable, "-E", "-c", FIND, *ours], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert found.stdout.split() == []
