"""`wildgs.export`: formats, names of files, and what is given twice."""

from __future__ import annotations

from pathlib import Path

import pytest

import wildgs
from wildgs.errors import UserError
from wildgs.exporters.config import CleanupConfig


@pytest.fixture(scope="module")
def scene(trained: Path) -> wildgs.LoadedScene:
    return wildgs.load(trained)


@pytest.mark.parametrize("kind", ["obj", "PLY", "usdz", "gltf", ""])
def test_unknown_formats_are_refused(kind: str, scene, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=f"unknown format '{kind}'; choose html, glb, usd, ply"):
        wildgs.export(scene, ["ply", kind], output=tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"title": "The gate"}, "--title is only used for html, glb and usd"),
        ({"spz_version": 3}, "--spz-version is only used for spz"),
    ],
)
def test_options_of_other_formats_are_refused(options, message: str, scene, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=message):
        wildgs.export(scene, ["ply", "sog"], output=tmp_path / "out", **options)
    assert list(tmp_path.iterdir()) == []


def test_outputs_are_checked_before_the_work(scene, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(type(scene), "appearance", lambda *_, **__: pytest.fail("encoded"))
    (tmp_path / "file").write_text("")
    names = [view.name for view in scene.views[:2]]
    for formats, appearance, output, message in (
        ("html", (), "e8.htm", r"end in \.html"),
        ("ply", (), "x.compressed.ply", r"end in \.ply"),
        (("html", "ply"), (), "exp2.html", "2 files"),
        ("ply", names, "two.ply", "2 files"),
        ("ply", (), "file", "is a file"),
    ):
        with pytest.raises(UserError, match=message):
            wildgs.export(scene, formats, appearance=appearance, output=tmp_path / output)
    for output in ("sheet.tiff", "file"):
        with pytest.raises(UserError, match=r"\.jpg|is a file"):
            wildgs.gallery(scene, tmp_path / output)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_what_is_given_twice_is_written_once(scene, tmp_path: Path) -> None:
    name = scene.views[0].name
    twice = [name, Path(name).stem, name]
    (page,) = wildgs.export(scene, ["html", "html"], appearance=twice, output=tmp_path / "A.HTML")
    assert page.file == tmp_path / "A.HTML"
    assert page.file.is_file()
    assert len(page.looks) == 1
    drop = CleanupConfig(sh_degree=0)
    (one,) = wildgs.export(scene, ["ply", "ply"], appearance=twice, output=tmp_path, cleanup=drop)
    assert one.file == tmp_path / f"{Path(name).stem}.ply"
    written = wildgs.gallery(scene, tmp_path / "b.jpg", views=twice, appearance=twice)
    assert (written.views, len(written.looks)) == ((name,), 1)


def test_a_folder_with_the_name_of_a_file_is_a_folder(scene, tmp_path: Path) -> None:
    (tmp_path / "a.html").mkdir()
    (page,) = wildgs.export(scene, appearance="neutral", output=tmp_path / "a.html")
    assert page.file == tmp_path / "a.html" / "page.html"
