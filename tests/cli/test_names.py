"""Names that phones and old disks write, from training to the report."""

from __future__ import annotations

import os
from pathlib import Path

from wildgs.library.loaded import LoadedScene
from wildgs.library.pages import write_showcase
from wildgs.runs import load_run

NAMES = ["2023-07-14 18:22:31.png", "caf\udce9.png", "ü [b]x[/b].png", "<img src=x>.png", "p5.png", "p6.png"]


def test_names_of_any_bytes_go_from_training_to_the_report(
    make_scene, tmp_path: Path, wildgs, capsys
) -> None:
    folder = tmp_path / os.fsdecode(b"sc\xe8ne")
    root = make_scene(names=[name.replace("\udce9", "#") for name in NAMES])
    (root / "images/caf#.png").rename(root / "images/caf\udce9.png")
    model = root / "sparse/0/images.bin"
    model.write_bytes(model.read_bytes().replace(b"caf#", b"caf\xe9"))
    root.rename(folder)
    run = tmp_path / "run ü"
    options = ("--method", "3dgs", "--steps", 2)
    assert wildgs("train", folder, "--output", tmp_path / os.fsdecode(b"r\xf9n"), *options) == 2
    assert r"r\xf9n: TensorBoard cannot write" in capsys.readouterr().err
    assert wildgs("train", folder, "--output", run, *options) == 0
    assert wildgs("eval", run, "--protocol", "full") == 0
    capsys.readouterr().out.encode()
    assert len(list((run / "eval/full").glob("*.png"))) == 1
    loaded = load_run(run)
    scene = loaded.read_scene()
    assert {view.name for view in scene.views} == set(NAMES)
    page = tmp_path / "report.html"
    write_showcase(page, folder.name, f"{folder}", scene, [("3dgs", LoadedScene(loaded), {})])
    html = page.read_text(encoding="utf-8")
    assert r"sc\xe8ne" in html
    assert "<img src=x>" not in html
