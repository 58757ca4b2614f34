"""`wildgs export`: every format from one tiny run."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

import wildgs as api


def _names(run: Path) -> list[str]:
    return [view.name for view in api.load(run).scene.train_views]


def test_the_page_holds_the_lights_asked_for(wildgs, trained: Path, tmp_path: Path, capsys) -> None:
    names = _names(trained)[:2]
    file = tmp_path / "gate.html"
    assert wildgs("export", trained, "--appearance", *names, "--output", file, "--title", "The gate") == 0
    text = file.read_text(encoding="utf-8")
    header = json.loads(text.split('id="header">')[1].split("</script>")[0])
    assert [light["name"] for light in header["lights"]] == names
    gaussians = api.load(trained).gaussians
    assert header["filter"] == {"eps2d": gaussians.eps2d, "antialiased": gaussians.antialiased}
    assert "<title>The gate</title>" in text
    said = capsys.readouterr().out
    assert str(file) in said
    assert "antialiased" not in said  # the page is


def test_without_appearances_the_page_takes_the_lights_of_a_day(
    wildgs, trained: Path, tmp_path: Path
) -> None:
    assert wildgs("export", trained, "--output", tmp_path) == 0
    header = (
        (tmp_path / "page.html").read_text(encoding="utf-8").split('id="header">')[1].split("</script>")[0]
    )
    found = json.loads(header)
    assert found["day"]
    assert 4 <= len({light["name"] for light in found["lights"]}) <= 6


def test_a_file_is_baked_for_each_appearance_in_the_inputs_frame(
    wildgs, trained: Path, tmp_path: Path
) -> None:
    gsply = pytest.importorskip("gsply")
    names = _names(trained)[:2]
    assert wildgs("export", trained, "--format", "ply", "--appearance", *names, "--output", tmp_path) == 0
    loaded = api.load(trained)
    for name in names:
        read = gsply.plyread(tmp_path / f"{Path(name).stem}.ply")
        back = loaded.run.alignment.apply_points(torch.from_numpy(np.array(read.means)))
        torch.testing.assert_close(back, loaded.gaussians.means.detach(), atol=1e-4, rtol=1e-4)
    assert wildgs("export", trained, "--format", "ply", "--appearance", names[0], "--aligned", "--output",
                  tmp_path / "one.ply") == 0  # fmt: skip
    read = gsply.plyread(tmp_path / "one.ply")
    np.testing.assert_array_equal(read.means, loaded.gaussians.means.detach().numpy())
    np.testing.assert_array_equal(read.sh0, loaded.appearance(names[0]).sh[:, 0].numpy())


def test_files_of_other_programs_come_with_a_note_about_their_filter(
    wildgs, trained: Path, tmp_path: Path, capsys
) -> None:
    assert api.load(trained).gaussians.antialiased
    assert wildgs("export", trained, "--format", "ply", "--output", tmp_path) == 0
    assert "antialiased" in capsys.readouterr().out


def test_what_is_left_out_and_its_cost_are_printed(wildgs, trained: Path, tmp_path: Path, capsys) -> None:
    name = _names(trained)[0]
    assert wildgs("export", trained, "--format", "ply", "--appearance", name, "--output", tmp_path,
                  "--min-opacity", "0.09", "--sh-degree", "1", "--crop", "1") == 0  # fmt: skip
    assert "dB PSNR against all Gaussians" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--appearance", "nobody.jpg"], "nobody.jpg"),
        (["--format", "ply", "--min-opacity", "1"], "drop all Gaussians"),
        (["--min-opacity", "2"], "--min-opacity 2.0: must be from 0 to 1"),
        (["--crop", "nan"], "--crop nan"),
        (["--sh-degree", "7"], "--sh-degree 7"),
    ],
)
def test_mistakes_are_one_line(wildgs, trained: Path, tmp_path: Path, capsys, arguments, message) -> None:
    names = [] if "--appearance" in arguments else ["--appearance", _names(trained)[0]]
    assert wildgs("export", trained, "--output", tmp_path / "out", *arguments, *names) == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert error.startswith("error: ")
    assert message in error
    assert not (tmp_path / "out").exists()


def test_glb_and_usd_hold_all_lights(wildgs, trained: Path, tmp_path: Path, capsys) -> None:
    pytest.importorskip("pxr.UsdVol", reason="usd-core is not installed")
    names = _names(trained)[:3]
    assert (
        wildgs("export", trained, "--format", "glb", "usd", "--appearance", *names, "--output", tmp_path) == 0
    )
    assert sorted(path.name for path in tmp_path.iterdir()) == ["scene.glb", "scene.usd"]
    said = capsys.readouterr().out
    assert said.count("Gaussians, 3 lights") == 2
    content = (tmp_path / "scene.glb").read_bytes()
    described = json.loads(content[20 : 20 + int.from_bytes(content[12:16], "little")])
    assert [scene["name"] for scene in described["scenes"]] == names
    back = described["asset"]["extras"]["to_colmap"]
    low = described["accessors"][0]["min"]
    assert np.isfinite(low).all()
    assert np.linalg.det(back["rotation"]) == pytest.approx(1.0)
    assert back["scale"] == pytest.approx(1.0)
