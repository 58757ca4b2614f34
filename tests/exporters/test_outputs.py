"""Output paths: a file or a folder, known before the work begins."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import pytest

from wildgs.errors import UserError
from wildgs.exporters.outputs import EXPORT_SUFFIXES, names_file
from wildgs.exporters.video import check_output
from wildgs.library.config import ExportFormat


def test_a_name_is_that_of_a_file_in_any_case_or_of_a_folder(tmp_path: Path) -> None:
    assert names_file(tmp_path / "E9.HTML", (".html",))
    assert names_file(tmp_path / "a.compressed.ply", (".compressed.ply",))
    assert not names_file(tmp_path / "run.v2", (".html",))
    assert not names_file(tmp_path / "many", (".html", ".ply"), files=2)
    (tmp_path / "old.ply").mkdir()
    assert not names_file(tmp_path / "old.ply", (".html",))


@pytest.mark.parametrize(
    ("name", "suffixes", "message"),
    [
        ("e8.htm", (".html",), r"end in \.html"),
        ("e10.gltf", (".glb",), r"end in \.glb"),
        ("exp_t.spz", (".ply",), r"end in \.ply"),
        (
            "x.compressed.ply",
            (".ply",),
            r"\.compressed\.ply is not what is written; let the name end in \.ply",
        ),
        ("sheet.TIFF", (".jpg", ".jpeg", ".png"), r"end in \.jpg, \.jpeg or \.png,"),
    ],
)
def test_names_of_other_files_are_refused(name: str, suffixes: tuple, message: str, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=message):
        names_file(tmp_path / name, suffixes)


def test_every_format_has_its_extension() -> None:
    assert tuple(f".{kind}" for kind in get_args(ExportFormat)) == EXPORT_SUFFIXES


def test_names_that_are_too_long_are_left_to_the_writer(tmp_path: Path) -> None:
    assert names_file(tmp_path / f"{'x' * 300}.html", (".html",))
    assert not names_file(tmp_path / ("x" * 300), (".html",))


def test_several_files_need_a_folder(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="2 files are written; give a folder"):
        names_file(tmp_path / "exp2.html", (".html", ".ply"), files=2)


def test_a_file_is_no_folder(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "file", tmp_path / "file" / "sub"):
        with pytest.raises(UserError, match="file is a file; give a folder"):
            names_file(path, (".html",))
        with pytest.raises(UserError, match="file is a file; give a folder"):
            check_output(path)
    with pytest.raises(UserError, match="file is a file; give a folder"):
        names_file(tmp_path / "file" / "a.html", (".html",))
