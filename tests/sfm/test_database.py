import multiprocessing
import time
from pathlib import Path

import pycolmap
import pytest

from wildgs.sfm import database as database_module
from wildgs.sfm.database import open_database

SECONDS = 3.0


def open_repeatedly(file: Path, seconds: float) -> None:
    """Opens and closes a database all the time, as processes that map do."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        with open_database(file) as database:
            database.read_all_images()


def test_processes_open_a_database_at_the_same_time(tmp_path: Path) -> None:
    """pycolmap's own opening fails hundreds of times per second here."""
    file = tmp_path / "database.db"
    with open_database(file) as database:
        assert database.num_images() == 0
    spawn = multiprocessing.get_context("spawn")
    processes = [spawn.Process(target=open_repeatedly, args=(file, SECONDS)) for _ in range(3)]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
    assert [process.exitcode for process in processes] == [0, 0, 0]


def test_opening_is_tried_again_until_it_succeeds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file, attempts, own = tmp_path / "database.db", 0, pycolmap.Database.open

    def busy(path: Path) -> pycolmap.Database:
        nonlocal attempts
        attempts += 1
        if attempts < 3:
            raise RuntimeError("No registered database factory succeeded.")
        return own(path)

    monkeypatch.setattr(pycolmap.Database, "open", busy)
    with open_database(file) as database:
        assert database.num_images() == 0
    assert attempts == 3


def test_what_never_opens_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(database_module, "PATIENCE", 0.2)
    (tmp_path / "database.db").write_bytes(b"no database" * 1000)
    with pytest.raises(RuntimeError), open_database(tmp_path / "database.db"):
        pass


def test_a_folder_that_is_gone_is_told_at_once(tmp_path: Path) -> None:
    started = time.monotonic()
    with pytest.raises(RuntimeError), open_database(tmp_path / "gone" / "database.db"):
        pass
    assert time.monotonic() - started < database_module.PATIENCE / 2


def test_it_is_closed_after_an_error(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), open_database(tmp_path / "database.db"):
        raise ZeroDivisionError
    assert not (tmp_path / "database.db-wal").exists(), "SQLite removes it when the last connection is closed"
