"""conftest.py: the whole suite runs in several processes, which start no further ones."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest


def workers_of(pytestconfig: pytest.Config) -> int | None:
    """The number of processes that conftest.py asks for when the whole suite is run."""
    file = str(Path(__file__).with_name("conftest.py"))
    plugins = pytestconfig.pluginmanager.get_plugins()
    conftest = next(plugin for plugin in plugins if getattr(plugin, "__file__", None) == file)
    asked = SimpleNamespace(
        args_source="testpaths",
        ArgsSource=SimpleNamespace(ARGS="args"),
        pluginmanager=SimpleNamespace(hasplugin=lambda name: True),
        option=SimpleNamespace(usepdb=False, numprocesses=None, dist="no"),
    )
    conftest.pytest_cmdline_main(asked)
    return asked.option.numprocesses


def test_workers_start_no_workers(pytestconfig: pytest.Config, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("PYTEST_XDIST_WORKER", raising=False)
    assert workers_of(pytestconfig)
    monkeypatch.setenv("PYTEST_XDIST_WORKER", "gw0")
    assert workers_of(pytestconfig) is None
