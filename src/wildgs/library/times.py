"""Capture times and places of a run's photos, from EXIF data."""

from __future__ import annotations

from pathlib import Path

from wildgs.errors import UserError
from wildgs.files import is_file
from wildgs.library.loaded import LoadedScene
from wildgs.light.captures import Capture, read_capture
from wildgs.scene.colmap import find_model
from wildgs.scene.photo_store import with_ending


def read_captures(loaded: LoadedScene, photos: Path | None = None) -> dict[str, Capture]:
    """Reads time and place of all photos that have EXIF data.

    Args:
        loaded: The run.
        photos: Folder of the original photos, whose extensions may differ from those of the scene. None looks in
            the run's scene folder (undistorted photos of `wildgs sfm` keep EXIF time and place) and at the copies
            in the run folder.

    Raises:
        UserError: The folder `photos` does not exist.
    """
    originals = None if photos is None else _by_stem(photos)
    folder = photos or _scene_photos(loaded)
    found = {}
    for view in loaded.views:
        files = [folder and folder / view.name]
        if originals is None:
            files.append(view.photos.file(view.name))
        else:
            files.append(originals.get(with_ending(view.name, "")))
        captures = (read_capture(file) for file in files if file is not None and is_file(file))
        found[view.name] = next((capture for capture in captures if capture is not None), None)
    return {name: capture for name, capture in found.items() if capture is not None}


def _by_stem(photos: Path) -> dict[str, Path]:
    """The files of a folder by relative path without extension."""
    if not photos.is_dir():
        raise UserError(f"{photos}: no such folder; give the folder of the original photos")
    return {
        with_ending(path.relative_to(photos).as_posix(), ""): path
        for path in sorted(photos.rglob("*"))
        if is_file(path)
    }


def _scene_photos(loaded: LoadedScene) -> Path | None:
    try:
        return find_model(Path(loaded.run.config.scene))[1]
    except Exception:  # a run works without its scene folder
        return None


def read_times(loaded: LoadedScene) -> dict[str, str]:
    """Local capture times in ISO 8601, by photo name."""
    return {name: capture.local.isoformat() for name, capture in read_captures(loaded).items()}
