from contextlib import closing
from pathlib import Path

import pycolmap
import pytest
from PIL import Image

from wildgs.errors import UserError, WildGSWarning
from wildgs.sfm.config import SfmConfig
from wildgs.sfm.upright import WorkingCopy
from wildgs.sfm.workplace import open_workplace, work_folder


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    (tmp_path / "p").mkdir()
    for name in "ab":
        Image.new("RGB", (8, 8)).save(tmp_path / "p" / f"{name}.jpg")
    return tmp_path / "p"


def work_until_interrupted(photos: Path, output: Path, copies: list[WorkingCopy]) -> None:
    with open_workplace(photos, output, SfmConfig()) as work:
        work.save_copies(copies, {"c.jpg": "broken"})
        work.set_done("matches")
        raise KeyboardInterrupt


def interrupt(photos: Path, output: Path) -> list[WorkingCopy]:
    place = (48.0, 2.0)
    copies = [
        WorkingCopy("a.jpg", "0.jpg", "a.jpg", False, place),
        WorkingCopy("b.jpg", "1.jpg", "b.jpg", True),
    ]
    with (
        pytest.warns(WildGSWarning, match="run the same command to continue"),
        pytest.raises(KeyboardInterrupt),
    ):
        work_until_interrupted(photos, output, copies)
    return copies


def test_interrupted_work_continues(photos: Path, tmp_path: Path) -> None:
    copies = interrupt(photos, tmp_path / "out")
    assert work_folder(tmp_path / "out").is_dir()
    with open_workplace(photos, tmp_path / "out", SfmConfig()) as work:
        assert work.load_copies() == (copies, {"c.jpg": "broken"})
        assert work.is_done("matches")
        assert work.load_models("first") is None
    assert sorted(p.name for p in tmp_path.iterdir()) == ["p"]


@pytest.mark.parametrize("damage", [lambda content: content[:5000], lambda content: content[:4096] * 3])
def test_a_damaged_database_is_not_continued(photos: Path, tmp_path: Path, damage) -> None:
    """COLMAP ends the process when it reads one, every time anew."""
    interrupt(photos, tmp_path / "out")
    database = work_folder(tmp_path / "out") / "database.db"
    with closing(pycolmap.Database.open(database)):
        pass
    with open_workplace(photos, tmp_path / "out", SfmConfig()) as work:
        assert work.is_done("matches")
    interrupt(photos, tmp_path / "out")
    with closing(pycolmap.Database.open(database)):
        pass
    database.write_bytes(damage(database.read_bytes()))
    with (
        pytest.warns(WildGSWarning, match="damaged; starting again"),
        open_workplace(photos, tmp_path / "out", SfmConfig()) as work,
    ):
        assert not work.is_done("matches")


@pytest.mark.parametrize("change", ["cut", "gone", "record"])
def test_copies_that_are_not_as_they_were_written_are_made_anew(
    photos: Path, tmp_path: Path, change: str
) -> None:
    with open_workplace(photos, tmp_path / "out", SfmConfig()) as work:
        work.images.mkdir()
        copy = work.images / "0.jpg"
        copy.write_bytes(b"a photo")
        work.save_copies([], {})
        assert work.load_copies() == ([], {})
        if change == "cut":
            copy.write_bytes(b"")
        elif change == "gone":
            copy.unlink()
        else:
            (work.root / "copies.json").write_text('{"copies": [{"name": 3}], "broken": {}}')
        assert work.load_copies() is None


def test_a_damaged_model_is_mapped_again(photos: Path, tmp_path: Path) -> None:
    with open_workplace(photos, tmp_path / "out", SfmConfig()) as work:
        work.save_models("first", [pycolmap.Reconstruction()])
        models = work.load_models("first")
        assert models is not None
        assert len(models) == 1
        (work.root / "first/0/cameras.bin").write_bytes(b"")
        assert work.load_models("first") is None


@pytest.mark.parametrize("what", ["photos", "options"])
def test_other_photos_or_options_begin_anew(photos: Path, tmp_path: Path, what: str) -> None:
    interrupt(photos, tmp_path / "out")
    if what == "photos":
        Image.new("RGB", (9, 9)).save(photos / "c.jpg")
    config = SfmConfig(seed=1) if what == "options" else SfmConfig()
    with open_workplace(photos, tmp_path / "out", config) as work:
        assert work.load_copies() is None
        assert not work.is_done("matches")


def test_two_processes_do_not_work_on_one_output(photos: Path, tmp_path: Path) -> None:
    with (
        open_workplace(photos, tmp_path / "out", SfmConfig()),
        pytest.raises(UserError, match="another process"),
        open_workplace(photos, tmp_path / "out", SfmConfig()),
    ):
        pass
    assert sorted(p.name for p in tmp_path.iterdir()) == ["p"]
