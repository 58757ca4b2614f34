"""The verbs on a tiny landmark: what they leave on disk, and one line for every mistake."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
import warnings
from pathlib import Path

import pytest
import yaml
from PIL import Image

from wildgs.cli import VERBS, doctor
from wildgs.errors import WildGSWarning
from wildgs.scene import demo


def complaint(capsys: pytest.CaptureFixture[str]) -> str:
    """The one line on stderr."""
    lines = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("warning:")]
    assert len(lines) == 1, lines
    assert lines[0].startswith("error: ")
    return lines[0]


def test_a_warning_is_printed_once(wildgs, monkeypatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Also if its cause is met several times, as a folder that a verb reads more than once."""

    def run(_: object) -> None:
        for photos in (1, 1, 2, 1):
            warnings.warn(f"{photos} unused", WildGSWarning, stacklevel=1)

    monkeypatch.setattr(doctor, "run", run)
    for _ in range(2):
        wildgs("doctor")
        assert capsys.readouterr().err.splitlines() == ["warning: 1 unused", "warning: 2 unused"]


def test_train_leaves_a_run_folder(trained: Path) -> None:
    config = yaml.safe_load((trained / "config.yaml").read_text())
    assert config["method"] == "wildgs"
    assert config["train"]["steps"] == 40
    assert [path.name for path in (trained / "checkpoints").iterdir()] == ["step_00000040.safetensors"]
    assert (trained / "tensorboard").is_dir()


def test_eval_writes_both_protocols(trained: Path, wildgs, landmark: Path) -> None:
    assert wildgs("eval", trained) == 0
    for protocol in ("full", "half"):
        metrics = json.loads((trained / "eval" / protocol / "metrics.json").read_text())
        assert metrics["protocol"] == protocol
        assert metrics["step"] == 40
        assert metrics["train_seconds"] > 0
        assert metrics["mean"]["psnr"] > 5
        for image in metrics["images"]:
            stem = Path(image["name"]).stem
            picture = Image.open(trained / "eval" / protocol / f"{stem}.png")
            photo = Image.open(landmark / "images" / image["name"])
            with picture, photo:
                assert picture.size == photo.size


def test_render_exchanges_light(trained: Path, wildgs, landmark: Path, tmp_path: Path) -> None:
    names = sorted(path.name for path in (landmark / "images").iterdir())[:2]
    assert wildgs("render", trained, "--view", names[0], "--appearance", *names, "--output", tmp_path) == 0
    stems = [Path(name).stem for name in names]
    pictures = [(tmp_path / stem / f"{stems[0]}.png").read_bytes() for stem in stems]
    assert pictures[0] != pictures[1]


def test_resume_does_nothing_more_to_a_finished_run(trained: Path, wildgs, landmark: Path) -> None:
    before = (trained / "checkpoints" / "step_00000040.safetensors").read_bytes()
    assert wildgs("train", landmark, "--output", trained, "--resume") == 0
    assert (trained / "checkpoints" / "step_00000040.safetensors").read_bytes() == before


def test_demo_ends_with_a_page(
    wildgs, tmp_path: Path, landmark: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    small = Path(shutil.make_archive(str(tmp_path / "small"), "zip", landmark))
    monkeypatch.setattr(demo, "ARCHIVE", small)
    output = tmp_path / "demo"
    assert wildgs("demo", "--output", output, "--steps", 20) == 0
    page = (output / "report.html").read_text()
    assert "3DGS" in page
    assert "Wild-GS" in page
    assert page.count("data:image/jpeg;base64,") >= 8
    for method in ("wildgs", "3dgs"):
        assert (output / method / "eval" / "half" / "metrics.json").is_file()


MISTAKES = {
    "unknown verb": (("fly",), "unknown command 'fly'"),
    "scene missing": (("train", "{tmp}/nowhere", "--output", "{tmp}/run"), "nowhere"),
    "not a run": (("eval", "{tmp}"), "not a run folder"),
    "run exists": (("train", "{landmark}", "--output", "{trained}"), "already holds a run"),
    "nothing to resume": (("train", "{landmark}", "--output", "{tmp}/new", "--resume"), "without --resume"),
    "empty output": (("run", "{landmark}/images", "--output", ""), "the value of --output is empty"),
    "empty path": (("train", "", "--output={tmp}/run"), "is empty"),
    "empty by equals": (("train", "{landmark}", "--output="), "the value of --output is empty"),
    "no LPIPS weights": (
        ("eval", "{trained}", "--lpips", "{tmp}/nowhere"),
        "no such folder; leave it out",
    ),
    "unknown photo": (
        ("render", "{trained}", "--appearance", "x.jpg", "--output", "{tmp}/o"),
        "neither a photo",
    ),
    "no photos": (("sfm", "{tmp}", "--output", "{tmp}/../scene-elsewhere"), "no photo"),
    "no room for a colour": (
        ("train", "{landmark}", "--output", "{tmp}/run", "--fusion.intrinsic-size", "2"),
        "--fusion.intrinsic-size 2: must be 3 or more",
    ),
    "bad downscale": (("train", "{landmark}", "--output", "{tmp}/run", "--downscale", "0"), "downscale"),
}


@pytest.mark.parametrize("case", list(MISTAKES))
def test_mistakes_are_one_line_and_code_2(
    case: str, wildgs, trained: Path, landmark: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments, expected = MISTAKES[case]
    capsys.readouterr()
    filled = [a.format(tmp=tmp_path, landmark=landmark, trained=trained) for a in arguments]
    assert wildgs(*filled) == 2
    assert expected in complaint(capsys)


def test_unknown_option_is_code_2(wildgs, landmark: Path, tmp_path: Path) -> None:
    assert wildgs("train", landmark, "--output", tmp_path / "run", "--no-such-option") == 2


def test_damaged_configuration_names_the_entry(trained: Path, wildgs, tmp_path: Path, capsys) -> None:
    run = tmp_path / "run"
    run.mkdir()
    config = yaml.safe_load((trained / "config.yaml").read_text())
    config["train"]["steps"] = "many"
    (run / "config.yaml").write_text(yaml.safe_dump(config))
    capsys.readouterr()
    assert wildgs("eval", run) == 2
    assert "train.steps" in complaint(capsys)


@pytest.mark.parametrize("verb", list(VERBS))
def test_every_verb_shows_an_example(verb: str, wildgs, capsys: pytest.CaptureFixture[str]) -> None:
    assert wildgs(verb, "--help") == 0
    assert f"Example: wildgs {verb}" in " ".join(capsys.readouterr().out.split())


def test_help_as_a_subprocess_is_instant_and_loads_no_torch() -> None:
    code = "import sys; from wildgs.cli import main; main(['--help']); assert 'torch' not in sys.modules"
    start = time.monotonic()
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert "wildgs COMMAND" in result.stdout
    assert time.monotonic() - start < 5


@pytest.mark.parametrize("arguments", ["'demo', '--help'", "'--version'", "'doctor'"])
@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_a_reader_who_leaves_early_sees_no_traceback(arguments: str, unbuffered: str) -> None:
    code = f"from wildgs.cli import main; main([{arguments}])"
    reader, writer = os.pipe()
    os.close(reader)
    environment = os.environ | {"PYTHONUNBUFFERED": unbuffered}
    with os.fdopen(writer, "w") as pipe:
        command = [sys.executable, "-c", code]
        result = subprocess.run(command, stdout=pipe, stderr=subprocess.PIPE, text=True, env=environment)
    assert (result.returncode, result.stderr) == (141, "")


def test_mistake_as_a_subprocess(tmp_path: Path) -> None:
    command = [
        sys.executable,
        "-c",
        "from wildgs.cli import main; main()",
        "train",
        str(tmp_path / "no scene"),
    ]
    result = subprocess.run(
        [*command, "--output", str(tmp_path / "run")], capture_output=True, text=True, check=False
    )
    assert result.returncode == 2
    assert "Traceback" not in result.stderr
    assert "no scene" in result.stderr
