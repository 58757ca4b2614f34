"""Damaged files of every kind in every reader: a result or a user's mistake, nothing else.

The same damage for longer, with limits on memory and time in a child process: benchmarks/fuzz.py.
"""

from __future__ import annotations

import importlib.util
import random
import re
import sys
import warnings
from pathlib import Path

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from wildgs.config import RunConfig
from wildgs.errors import UserError
from wildgs.plain_values import from_plain
from wildgs.scene.colmap import _checked_name

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "fuzz.py"
SOURCE = Path(__file__).parents[2] / "src"


def _load_script():
    spec = importlib.util.spec_from_file_location("fuzz", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["fuzz"] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


fuzz = _load_script()


@pytest.fixture(scope="module")
def seeds(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[Path, dict[str, bytes]]]:
    """For every reader a folder, and its files' valid contents."""
    found = {}
    for name, reader in fuzz.READERS.items():
        folder = tmp_path_factory.mktemp("fuzz")
        files = reader.seeds(folder)
        reader.read(folder)
        found[name] = (folder, {file: (folder / file).read_bytes() for file in files})
    return found


@pytest.mark.parametrize("name", list(fuzz.READERS))
@given(st.integers(0, 2**32))
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_no_reader_breaks(seeds, name: str, seed: int) -> None:
    folder, contents = seeds[name]
    rng = random.Random(seed)
    file = rng.choice(list(contents))
    (folder / file).write_bytes(fuzz.damage(contents[file], rng))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            fuzz.READERS[name].read(folder)
        said = ""
    except UserError as error:
        said = str(error)
    finally:
        (folder / file).write_bytes(contents[file])
    assert len(said) < 3000


plain = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8) | st.integers(), inner, max_size=3)
    ),
    max_leaves=8,
)
SECTIONS = ("scene", "method", "data", "model", "train")


@given(plain | st.dictionaries(st.sampled_from(SECTIONS), plain, max_size=5))
@settings(max_examples=200, deadline=None)
def test_plain_data_is_a_configuration_or_a_mistake(value: object) -> None:
    try:
        assert isinstance(from_plain(RunConfig, value), RunConfig)
    except UserError:
        return


@given(st.text() | st.lists(st.sampled_from(["..", ".", "a", "/", "\\", "C:", "\0", " "])).map("".join))
@example("..\\..\\x")
@example("a/../../x")
@example("C:\\x")
@example("/etc/passwd")
@example("a\0b")
@settings(deadline=None)
def test_no_name_leaves_the_folder(name: str) -> None:
    root = Path("/scene/images")
    try:
        checked = _checked_name(name, root)
    except UserError:
        return
    path = Path(root, checked)
    assert path.is_relative_to(root)
    assert ".." not in path.parts
    assert "\0" not in checked
    assert path != root


def test_nothing_is_unpickled() -> None:
    forbidden = re.compile(
        r"import pickle|pickle\.load|np\.load\(|joblib|yaml\.(unsafe_|full_)?load\((?!.*_Loader)|"
        r"torch\.load\((?!.*weights_only=True)|\bexec\(|allow_pickle"
    )
    found = [
        f"{path.name}: {line.strip()}"
        for path in SOURCE.rglob("*.py")
        for line in path.read_text(encoding="utf-8").splitlines()
        if forbidden.search(line)
    ]
    assert found == []


def test_pretrained_networks_are_read_from_safetensors_only() -> None:
    calls = [
        call
        for path in SOURCE.rglob("*.py")
        for call in re.findall(r"\.from_pretrained\([^)]*\)", path.read_text(encoding="utf-8"))
    ]
    assert calls
    assert [call for call in calls if "use_safetensors=True" not in call] == []
