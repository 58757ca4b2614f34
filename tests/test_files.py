"""A file is there whole or not at all."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from wildgs.errors import UserError
from wildgs.files import check_regular, is_file, written_aside


def test_a_file_takes_its_name_when_it_is_whole(tmp_path: Path) -> None:
    file = tmp_path / "new" / "a.txt"
    with written_aside(file) as aside:
        aside.write_text("whole")
        assert not file.exists()
    assert file.read_text() == "whole"
    assert list(file.parent.iterdir()) == [file]


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt(), ValueError()])
def test_what_was_there_stays_where_writing_fails(tmp_path: Path, error: BaseException) -> None:
    file = tmp_path / "a.txt"
    file.write_text("before")

    def write() -> None:
        with written_aside(file) as aside:
            aside.write_text("half")
            raise error

    with pytest.raises(UserError if isinstance(error, OSError) else type(error)):
        write()
    assert file.read_text() == "before"
    assert list(tmp_path.iterdir()) == [file]


@pytest.mark.parametrize("length", [250, 255])
def test_names_as_long_as_the_file_system_takes(tmp_path: Path, length: int) -> None:
    file = tmp_path / ("é" * 100 + "x" * (length - 200))
    with written_aside(file) as aside:
        aside.write_text("whole")
    assert file.read_text() == "whole"
    assert not is_file(tmp_path / ("x" * 256))


@pytest.mark.skipif(os.name == "nt", reason="Windows has no umask")
def test_a_file_has_the_permissions_of_any_new_file(tmp_path: Path) -> None:
    file = tmp_path / "a.txt"
    with written_aside(file, flush=True) as aside:
        aside.write_text("whole")
        aside.chmod(0o600)
    other = tmp_path / "other"
    other.write_bytes(b"")
    assert file.stat().st_mode == other.stat().st_mode


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes here")
def test_pipes_and_devices_are_not_regular_files(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", Path("/dev/zero"), tmp_path):
        with pytest.raises(OSError, match="not a regular file"):
            check_regular(path)
    (tmp_path / "a").write_bytes(b"")
    check_regular(tmp_path / "a")
