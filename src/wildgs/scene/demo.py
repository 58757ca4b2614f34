"""The scene that `wildgs demo` trains on: 40 rendered photos of a made-up landmark, which ship with the package."""

from __future__ import annotations

import zipfile
from pathlib import Path

ARCHIVE = Path(__file__).with_name("demo.zip")


def write_demo_scene(folder: Path) -> Path:
    """Unpacks the demo's scene: photos, COLMAP model, split, depth priors and the truth for scoring.

    A folder that holds the scene already is left as it is; one that is there holds all of it.

    Args:
        folder: The scene folder to make.

    Returns:
        The folder.
    """
    if not folder.exists():
        partial = folder.with_name(folder.name + ".partial")
        with zipfile.ZipFile(ARCHIVE) as archive:
            archive.extractall(partial)
        partial.rename(folder)
    return folder
