"""The scene of `wildgs demo`: 40 rendered photos of an artificial landmark, which ship with the package."""

from __future__ import annotations

import zipfile
from pathlib import Path

ARCHIVE = Path(__file__).with_name("demo.zip")


def write_demo_scene(folder: Path) -> Path:
    """Unpacks the demo's scene (photos, model, split, depth maps, ground truth) unless the folder exists."""
    if not folder.exists():
        partial = folder.with_name(folder.name + ".partial")
        with zipfile.ZipFile(ARCHIVE) as archive:
            archive.extractall(partial)
        partial.rename(folder)
    return folder
