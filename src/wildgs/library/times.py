"""When the photos of a run were taken, from the EXIF blocks of their files."""

from __future__ import annotations

from pathlib import Path

from wildgs.library.loaded import LoadedScene
from wildgs.light.captures import Capture, read_capture
from wildgs.scene.colmap import find_model


def read_captures(loaded: LoadedScene, photos: Path | None = None) -> dict[str, Capture]:
    """Time and place of the photos whose files can be found and say so.

    Args:
        loaded: The run.
        photos: Folder of the original photos; None looks in the scene folder of the run, where the undistorted
            photos of `wildgs sfm` keep time and place, and at the run's own copies of its photos.
    """
    found = {}
    folder = photos or _scene_photos(loaded)
    for view in loaded.views:
        files = [folder and folder / view.name, None if photos else view.photos.file(view.name)]
        captures = (read_capture(file) for file in files if file is not None)
        found[view.name] = next((capture for capture in captures if capture is not None), None)
    return {name: capture for name, capture in found.items() if capture is not None}


def _scene_photos(loaded: LoadedScene) -> Path | None:
    try:
        return find_model(Path(loaded.run.config.scene))[1]
    except Exception:  # a run works without its scene folder
        return None


def read_times(loaded: LoadedScene) -> dict[str, str]:
    """Local times in ISO 8601, by the names of photos."""
    return {name: capture.local.isoformat() for name, capture in read_captures(loaded).items()}
