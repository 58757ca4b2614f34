"""The command line called in this process."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from wildgs.cli import main

Wildgs = Callable[..., int]


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
