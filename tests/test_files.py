"""A file is there whole or not at all."""

from __future__ import annotations

from pathlib import Path

import pytest

from wildgs.errors import UserError
from wildgs.files import written_aside


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
