"""The demo's landmark, tiny, made once; and the command line called in this process."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from wildgs.cli import main
from wildgs.data.synthetic import SyntheticConfig, make_landmark

Wildgs = Callable[..., int]


@pytest.fixture(scope="session")
def landmark(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("landmark") / "scene"
    make_landmark(folder, SyntheticConfig(photos=9, test_every=4, long_side=48, points=1500, least_views=2))
    return folder


@pytest.fixture
def wildgs(capsys: pytest.CaptureFixture[str]) -> Wildgs:
    """Calls a verb; returns the exit code."""

    def call(*arguments: object) -> int:
        try:
            main([str(argument) for argument in arguments])
        except SystemExit as end:
            return int(end.code or 0)
        return 0

    return call
