import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
TEXT = (ROOT / "docs" / "paper_map.md").read_text(encoding="utf-8")
PLACES = sorted(set(re.findall(r"`([\w/]+\.py):([\w.]+)`", TEXT)))


def find(scope: ast.Module | ast.ClassDef, names: list[str]) -> bool:
    """Whether a function or class of that dotted name is defined in a scope."""
    for node in scope.body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and node.name == names[0]:
            if len(names) == 1:
                return True
            return isinstance(node, ast.ClassDef) and find(node, names[1:])
    return False


@pytest.mark.parametrize(("file", "name"), PLACES)
def test_named_place_exists(file, name):
    source = ROOT / "src" / "wildgs" / file
    assert source.is_file(), f"docs/paper_map.md names {file}, which does not exist"
    module = ast.parse(source.read_text(encoding="utf-8"))
    assert find(module, name.split(".")), f"docs/paper_map.md names {file}:{name}, which does not exist"


def test_every_row_names_a_place():
    rows = [
        line for line in TEXT.splitlines() if line.startswith("|") and not re.match(r"\|(-|\s*Paper)", line)
    ]
    assert len(rows) > 25
    for row in rows:
        assert re.search(r"`[\w/]+\.py:[\w.]+`", row), row


def test_a_name_that_does_not_exist_is_noticed():
    module = ast.parse("class A:\n    def f(self): ...\n\ndef g(): ...\n")
    assert find(module, ["A", "f"])
    assert find(module, ["g"])
    assert not find(module, ["f"])
    assert not find(module, ["A", "g"])
    assert not find(module, ["g", "f"])
