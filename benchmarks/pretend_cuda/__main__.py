"""`python benchmarks/pretend_cuda ARGUMENTS...`: pytest with these arguments, on the pretended device."""

from __future__ import annotations

import sys
from contextlib import ExitStack
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

import pretend_cuda


class Plugin:
    """Opens the device when pytest has read its configuration, before it collects tests."""

    def __init__(self) -> None:
        self.stack = ExitStack()

    def pytest_configure(self) -> None:
        """Opens it."""
        self.stack.enter_context(pretend_cuda.device())

    def pytest_unconfigure(self) -> None:
        """Closes it."""
        self.stack.close()


if __name__ == "__main__":
    pretend_cuda.prepare()
    import pytest

    sys.exit(pytest.main(sys.argv[1:], plugins=[Plugin()]))
