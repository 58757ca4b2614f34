"""`wildgs train --preset`: options that follow change what the preset sets."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from wildgs.presets import PRESET_NAMES


@pytest.mark.parametrize("name", PRESET_NAMES)
def test_options_change_what_a_preset_sets(name: str, landmark: Path, wildgs, tmp_path: Path) -> None:
    options = ("--preset", name, "--steps", 2, "--sky.points", 7, "--parsing.encoder", "nobody/none")
    assert wildgs("train", landmark, "--output", tmp_path / "run", *options, "--parsing.max-side", 32) == 0
    config = yaml.safe_load((tmp_path / "run/config.yaml").read_text())
    assert config["train"]["steps"] == 2
    assert config["model"]["sky"]["points"] == 7
    assert config["model"]["parsing"]["max_side"] == 32
    assert config["model"]["fusion"]["color_transform"] is (not name.startswith("paper"))
    assert config["train"]["schedule"]["encoder_every"] == (1 if name.startswith("paper") else 2)


def test_an_unknown_preset_is_a_mistake(wildgs, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert wildgs("train", tmp_path, "--output", tmp_path / "run", "--preset", "slow") == 2
    assert "slow" in capsys.readouterr().err
