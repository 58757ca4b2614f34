from pathlib import Path

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
    with pytest.warns(WildGSWarning, match="the same command continues"), pytest.raises(KeyboardInterrupt):
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
