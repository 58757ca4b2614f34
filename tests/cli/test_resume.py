"""What may change when a run is resumed, and what is refused."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import yaml

from wildgs.config_file import read_config
from wildgs.errors import WildGSWarning
from wildgs.runs import load_run

TRAIN = ("--method", "3dgs", "--steps", 6, "--downscale", 2)


def complaint(capsys: pytest.CaptureFixture[str]) -> str:
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]
    return line


@pytest.fixture
def run(landmark: Path, tmp_path: Path, wildgs) -> Path:
    """A short run."""
    assert wildgs("train", landmark, "--output", tmp_path / "run", *TRAIN) == 0
    return tmp_path / "run"


def test_options_that_would_change_the_run_are_refused_by_name(
    run: Path, landmark: Path, wildgs, capsys
) -> None:
    before = (run / "config.yaml").read_bytes()
    capsys.readouterr()
    options = ("--steps", 5000, "--downscale", 1, "--max-side", 20, "--optimizer.means", 1e-3)
    assert wildgs("train", landmark, "--output", run, "--resume", *options) == 2
    line = complaint(capsys)
    assert "--steps 5000 (the run has 6)" in line
    assert "--downscale 1" in line
    assert "--max-side 20 (the run has None)" in line
    assert "--optimizer.means 0.001" in line
    assert (run / "config.yaml").read_bytes() == before


def test_the_default_is_refused_where_it_was_asked_for(run: Path, landmark: Path, wildgs, capsys) -> None:
    """An option that equals the default of a new run is still another one than the run's."""
    capsys.readouterr()
    assert wildgs("train", landmark, "--output", run, "--resume", "--steps", 30_000) == 2
    assert "--steps 30000 (the run has 6)" in complaint(capsys)


def test_the_same_command_and_other_execution_go_on(run: Path, landmark: Path, wildgs) -> None:
    execution = ("--image-cache", "1MB", "--checkpoint-every", 3, "--threads", 1, "--no-cuda-graphs")
    assert wildgs("train", landmark, "--output", run, "--resume", *TRAIN) == 0
    assert wildgs("train", landmark, "--output", run, "--resume", *execution) == 0


def test_a_configuration_that_was_edited_is_not_resumed(run: Path, landmark: Path, wildgs, capsys) -> None:
    """The first steps would be of one configuration and the others of another."""
    file = run / "config.yaml"
    file.write_text(file.read_text().replace("steps: 6", "steps: 60"))
    capsys.readouterr()
    assert wildgs("train", landmark, "--output", run, "--resume") == 2
    assert "changed after training began (train.steps was 6, is 60)" in complaint(capsys)
    with pytest.warns(WildGSWarning, match=r"changed after training \(train\.steps was 6, is 60\)"):
        load_run(run)


def test_the_scene_may_have_moved(run: Path, landmark: Path, tmp_path: Path, wildgs) -> None:
    moved = tmp_path / "elsewhere"
    shutil.copytree(landmark, moved)
    assert wildgs("train", moved, "--output", run, "--resume") == 0
    assert read_config(run / "config.yaml").scene == moved
    shutil.move(moved, tmp_path / "again")
    assert wildgs("eval", run, "--protocol", "full", "--scene", tmp_path / "again") == 0
    assert load_run(run).step == 6


def test_a_configuration_of_an_earlier_version_opens(run: Path, landmark: Path, wildgs) -> None:
    file = run / "config.yaml"
    plain = yaml.safe_load(file.read_text())
    plain["data"]["image_cache"] = "2GB"
    plain["train"]["cuda_graphs"] = False
    file.write_text(yaml.safe_dump(plain))
    assert wildgs("train", landmark, "--output", run, "--resume") == 0
