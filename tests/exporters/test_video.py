"""Videos and frames: readable again, the right length and colours, and never half-written under their name."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from wildgs.errors import UserError
from wildgs.exporters.video import check_output, write_frames

# imageio-ffmpeg leaves its pipes to the garbage collector, which is heard of in whatever test it comes to.
pytestmark = pytest.mark.filterwarnings(
    "ignore:unclosed file:ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning"
)

WIDTH, HEIGHT, COUNT = 66, 34, 12


def frames(count: int = COUNT) -> Iterator[np.ndarray]:
    for index in range(count):
        yield np.full((HEIGHT, WIDTH, 3), (20 * index, 128, 255 - 20 * index), dtype=np.uint8)


def broken() -> Iterator[np.ndarray]:
    yield from frames(3)
    raise RuntimeError("the renderer failed")


def read_video(path: Path) -> tuple[dict, np.ndarray]:
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")
    reader = imageio_ffmpeg.read_frames(str(path))
    meta = next(reader)
    pictures = [np.frombuffer(frame, np.uint8).reshape(HEIGHT, WIDTH, 3) for frame in reader]
    return meta, np.stack(pictures)


def test_a_video_has_all_frames_at_its_size_and_speed(tmp_path: Path) -> None:
    file = tmp_path / "sub" / "a film.mp4"
    write_frames(file, frames(), (WIDTH, HEIGHT), 24.0)
    meta, pictures = read_video(file)
    assert meta["size"] == (WIDTH, HEIGHT)
    assert meta["fps"] == 24
    assert meta["codec"] == "h264"
    assert len(pictures) == COUNT
    expected = np.stack(list(frames()))
    assert np.abs(pictures.astype(int) - expected).mean() < 6
    assert [path.name for path in file.parent.iterdir()] == [file.name]


def test_a_failure_leaves_no_video_and_no_rest(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match="renderer"):
        write_frames(tmp_path / "a.mp4", broken(), (WIDTH, HEIGHT), 24.0)
    assert list(tmp_path.iterdir()) == []


def test_a_failure_leaves_the_old_video(tmp_path: Path) -> None:
    file = tmp_path / "a.mp4"
    write_frames(file, frames(), (WIDTH, HEIGHT), 24.0)
    before = file.read_bytes()
    with pytest.raises(RuntimeError):
        write_frames(file, broken(), (WIDTH, HEIGHT), 24.0)
    assert file.read_bytes() == before


def test_frames_in_a_folder_are_lossless(tmp_path: Path) -> None:
    folder = tmp_path / "frames"
    write_frames(folder, frames(), (WIDTH, HEIGHT), 24.0)
    files = sorted(folder.iterdir())
    assert [file.name for file in files] == [f"frame_{i:05d}.png" for i in range(COUNT)]
    for file, expected in zip(files, frames(), strict=True):
        with Image.open(file) as picture:
            assert np.array_equal(np.asarray(picture), expected)


def test_a_shorter_sequence_leaves_no_frames_of_the_longer_one(tmp_path: Path) -> None:
    folder = tmp_path / "frames"
    write_frames(folder, frames(), (WIDTH, HEIGHT), 24.0)
    (folder / "notes.txt").write_text("mine")
    write_frames(folder, frames(3), (WIDTH, HEIGHT), 24.0)
    assert len(list(folder.glob("*.png"))) == 3
    assert (folder / "notes.txt").read_text() == "mine"


def test_a_failure_leaves_no_frames(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError):
        write_frames(tmp_path / "frames", broken(), (WIDTH, HEIGHT), 24.0)
    assert list(tmp_path.iterdir()) == []


def test_without_ffmpeg_one_line_says_how_to_get_it(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(UserError, match="pip install imageio-ffmpeg"):
        check_output(tmp_path / "a.mp4")
    check_output(tmp_path / "frames")  # these need nothing


def test_odd_sizes_and_strange_names_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="even"):
        write_frames(tmp_path / "a.mp4", frames(), (WIDTH + 1, HEIGHT), 24.0)
    with pytest.raises(UserError, match=r"\.mp4"):
        write_frames(tmp_path / "a.gif", frames(), (WIDTH, HEIGHT), 24.0)
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="is a file"):
        write_frames(tmp_path / "file", frames(), (WIDTH, HEIGHT), 24.0)


def test_a_video_that_ffmpeg_cannot_finish_leaves_the_old_one(tmp_path: Path) -> None:
    pytest.importorskip("imageio_ffmpeg")
    file = tmp_path / "a.mp4"
    write_frames(file, frames(), (WIDTH, HEIGHT), 24.0)
    before = file.read_bytes()
    script = f"""
import numpy as np, resource, signal
from pathlib import Path
from wildgs.exporters.video import write_frames
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (1024, 1024))
noise = np.random.default_rng(0).integers(0, 255, ({COUNT}, {HEIGHT}, {WIDTH}, 3)).astype(np.uint8)
write_frames(Path({str(file)!r}), noise, ({WIDTH}, {HEIGHT}), 24.0)
"""
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", script], capture_output=True, text=True)
    assert "UserError" in done.stderr
    assert file.read_bytes() == before
    assert list(tmp_path.iterdir()) == [file]
