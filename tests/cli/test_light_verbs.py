"""render, appearance, gallery on a tiny run: what they leave on disk, and one line for every mistake."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image


@pytest.fixture(scope="session")
def names(landmark: Path) -> list[str]:
    return sorted(path.name for path in (landmark / "images").iterdir())


def pixels(file: Path) -> np.ndarray:
    with Image.open(file) as picture:
        return np.asarray(picture).astype(int)


def complaint(capsys: pytest.CaptureFixture[str]) -> str:
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]
    assert len(lines) == 1, lines
    return lines[0]


def test_a_video_that_moves_and_changes_light(trained: Path, wildgs, names, tmp_path: Path) -> None:
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")
    file = tmp_path / "orbit.mp4"
    arguments = ("--appearance", names[0], "--to", names[1], "neutral", "--path", "orbit", "--seconds", 0.5)
    assert wildgs("render", trained, *arguments, "--fps", 20, "--output", file) == 0
    count, seconds = imageio_ffmpeg.count_frames_and_secs(str(file))
    assert (count, seconds) == (10, 0.5)
    assert [path.name for path in tmp_path.iterdir()] == [file.name]


@pytest.mark.parametrize("path", ["training", "spiral", "views"])
def test_frames_along_every_path(trained: Path, wildgs, names, tmp_path: Path, path: str) -> None:
    views = ("--view", *names[:3]) if path == "views" else ()
    options = ("--path", path, *views, "--seconds", 0.2, "--size", 40, 30, "--output", tmp_path / "frames")
    assert wildgs("render", trained, "--appearance", names[0], *options) == 0
    files = sorted((tmp_path / "frames").iterdir())
    assert len(files) == 6
    pictures = np.stack([pixels(file) for file in files])
    assert pictures.shape == (6, 30, 40, 3)
    assert np.abs(pictures[0] - pictures[-1]).mean() > 0.5


def test_a_still_camera_in_changing_light_begins_and_ends_as_the_stills(
    trained: Path, wildgs, names, tmp_path: Path
) -> None:
    video = ("--path", "still", "--view", names[0], "--appearance", names[0], "--to", names[1])
    assert wildgs("render", trained, *video, "--seconds", 0.2, "--output", tmp_path / "frames") == 0
    stills = ("--view", names[0], "--appearance", names[0], names[1])
    assert wildgs("render", trained, *stills, "--output", tmp_path / "stills") == 0
    frames = sorted((tmp_path / "frames").iterdir())
    for frame, light in ((frames[0], names[0]), (frames[-1], names[1])):
        still = tmp_path / "stills" / Path(light).stem / f"{Path(names[0]).stem}.png"
        assert np.array_equal(pixels(frame), pixels(still))


def test_a_camera_file_says_where_and_how_fast(trained: Path, wildgs, names, tmp_path: Path) -> None:
    camera = {"viewmat": np.eye(4).tolist(), "fov": 60, "width": 33, "height": 21}
    file = tmp_path / "path.json"
    file.write_text(json.dumps({"frame": "colmap", "fps": 5, "cameras": [camera] * 4}))
    output = tmp_path / "frames"
    assert wildgs("render", trained, "--appearance", names[0], "--path", file, "--output", output) == 0
    assert [pixels(picture).shape for picture in sorted(output.iterdir())] == [(21, 33, 3)] * 4


def test_a_saved_appearance_renders_as_its_photo(trained: Path, wildgs, names, tmp_path: Path) -> None:
    file = tmp_path / "evening.safetensors"
    assert wildgs("appearance", trained, names[1], "--output", file) == 0
    assert file.stat().st_size < 200_000
    for number, light in enumerate((file, names[1])):
        output = tmp_path / f"out{number}"
        assert wildgs("render", trained, "--view", names[0], "--appearance", light, "--output", output) == 0
    first, second = (pixels(next((tmp_path / f"out{n}").rglob("*.png"))) for n in (0, 1))
    assert np.abs(first - second).max() <= 1


def test_mixes_by_weights_and_by_parts(trained: Path, wildgs, names, tmp_path: Path) -> None:
    pictures = {}
    for kind, options in {
        "first": ("--appearance", names[0]),
        "second": ("--appearance", names[1]),
        "half": ("--appearance", *names[:2], "--weights", 0.5, 0.5),
        "all": ("--global", names[0], "--local", names[0]),
        "crossed": ("--appearance", names[0], "--global", names[1]),
    }.items():
        output = tmp_path / kind
        assert wildgs("render", trained, "--view", names[0], *options, "--output", output) == 0
        pictures[kind] = pixels(next(output.rglob("*.png")))
    assert np.array_equal(pictures["all"], pictures["first"])
    assert not np.array_equal(pictures["crossed"], pictures["first"])
    apart = np.abs(pictures["first"] - pictures["second"]).mean()
    assert np.abs(pictures["half"] - pictures["first"]).mean() < apart
    assert np.abs(pictures["half"] - pictures["second"]).mean() < apart


def test_any_picture_lends_its_light(trained: Path, wildgs, names, tmp_path: Path, capsys) -> None:
    painting = tmp_path / "painting.png"
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (30, 50, 3), dtype=np.uint8)).save(painting)
    options = ("--view", names[0], "--appearance", painting, "--like", names[2], "--output", tmp_path / "out")
    assert wildgs("render", trained, *options) == 0
    assert f"uses camera and depth of {names[2]}" in capsys.readouterr().out
    assert (tmp_path / "out" / "painting" / f"{Path(names[0]).stem}.png").is_file()


def test_a_gallery_has_a_tile_for_every_view_and_light(trained: Path, wildgs, names, tmp_path: Path) -> None:
    options = ("--view", *names[:2], "--appearance", *names[:3], "--output", tmp_path)
    assert wildgs("gallery", trained, *options) == 0
    assert len(list(tmp_path.rglob("*.png"))) == 6
    with Image.open(tmp_path / "gallery.jpg") as sheet:
        assert sheet.width > 4 * 30
        assert sheet.height > 3 * 30
    assert len({file.read_bytes() for file in tmp_path.rglob(f"{Path(names[0]).stem}.png")}) == 3


MISTAKES = {
    "unknown light": (("render", "{run}", "--appearance", "x.jpg", "--output", "{tmp}/o"), "'x.jpg'|x.jpg:"),
    "unknown view": (("render", "{run}", "--view", "x.jpg", "--output", "{tmp}/o"), "no photo 'x.jpg'"),
    "unknown path": (("render", "{run}", "--path", "zigzag", "--output", "{tmp}/o"), "choose orbit"),
    "no such file": (("render", "{run}", "--path", "{tmp}/a.json", "--output", "{tmp}/o"), "no such file"),
    "strange video": (("render", "{run}", "--output", "{tmp}/o.gif"), r"\.mp4"),
    "to without time": (("render", "{run}", "--to", "neutral", "--output", "{tmp}/o"), "--path"),
    "no time": (("render", "{run}", "--seconds", "0", "--output", "{tmp}/o.mp4"), "seconds"),
    "still of nothing": (("render", "{run}", "--path", "still", "--output", "{tmp}/o.mp4"), "one photo"),
    "bad weights": (
        ("render", "{run}", "--appearance", "{a}", "{b}", "--weights", "1", "1", "--output", "{tmp}/o"),
        "must add up to 1, not to 2",
    ),
    "bad ending": (("appearance", "{run}", "{a}", "--output", "{tmp}/o.pt"), "safetensors"),
    "two in one": (("appearance", "{run}", "{a}", "{b}", "--output", "{tmp}/o.safetensors"), "--weights"),
    "not a run": (("gallery", "{tmp}"), "not a run folder"),
}


@pytest.mark.parametrize("case", list(MISTAKES))
def test_mistakes_are_one_line_and_code_2(
    case: str, wildgs, trained: Path, names, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments, expected = MISTAKES[case]
    capsys.readouterr()
    assert wildgs(*[a.format(tmp=tmp_path, run=trained, a=names[0], b=names[1]) for a in arguments]) == 2
    message = complaint(capsys)
    assert any(words.replace("\\", "") in message for words in expected.split("|")), message
    assert list(tmp_path.iterdir()) == []
