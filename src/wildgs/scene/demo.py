"""The scene that `wildgs demo` trains on: 40 rendered photos of a made-up landmark, which ship with the package."""

from __future__ import annotations

import zipfile
from pathlib import Path

ARCHIVE = Path(__file__).with_name("demo.zip")


def write_demo_scene(folder: Path) -> Path:
    """Unpacks the demo's scene (photos, model, split, depth priors, truth) unless the folder exists."""
    if not folder.exists():
        partial = folder.with_name(folder.name + ".partial")
        with zipfile.ZipFile(ARCHIVE) as archive:
            archive.extractall(partial)
        partial.rename(folder)
    return folder
