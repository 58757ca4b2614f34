"""When the photos of a run were taken, from the EXIF blocks of their files."""

from __future__ import annotations

from pathlib import Path

from wildgs.errors import UserError
from wildgs.files import is_file
from wildgs.library.loaded import LoadedScene
from wildgs.light.captures import Capture, read_capture
from wildgs.scene.colmap import find_model
from wildgs.scene.photo_store import with_ending


def read_captures(loaded: LoadedScene, photos: Path | None = None) -> dict[str, Capture]:
    """Time and place of the photos whose files can be found and say so.

    Args:
        loaded: The run.
        photos: Folder of the original photos, whose endings may differ from those of the scene; None looks in the
            scene folder of the run. Undistorted photos of `wildgs sfm` have no EXIF blocks.

    Raises:
        UserError: There is no folder `photos`.
    """
    names = [view.name for view in loaded.views]
    if photos is not None:
        files = _by_stem(photos)
        found = {name: files[stem] for name in names if (stem := with_ending(name, "")) in files}
        found |= {name: photos / name for name in names if is_file(photos / name)}
    else:
        try:
            folder = find_model(Path(loaded.run.config.scene))[1]
        except Exception:  # a run works without its scene folder
            return {}
        found = {name: folder / name for name in names}
    captures = {name: read_capture(file) for name, file in found.items()}
    return {name: capture for name, capture in captures.items() if capture is not None}


def _by_stem(photos: Path) -> dict[str, Path]:
    """The files of a folder by their path in it without ending."""
    if not photos.is_dir():
        raise UserError(f"{photos}: no such folder; give the folder of the original photos")
    return {
        with_ending(path.relative_to(photos).as_posix(), ""): path
        for path in sorted(photos.rglob("*"))
        if is_file(path)
    }


def read_times(loaded: LoadedScene) -> dict[str, str]:
    """Local times in ISO 8601, by the names of photos."""
    return {name: capture.local.isoformat() for name, capture in read_captures(loaded).items()}
