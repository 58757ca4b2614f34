"""Checks of output paths: whether a name is that of a file or of a folder, before the work begins."""

from __future__ import annotations

from pathlib import Path

from wildgs.errors import UserError
from wildgs.files import is_there

PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg")
VIDEO_SUFFIXES = (".mp4", ".mkv", ".mov")
EXPORT_SUFFIXES = (".html", ".glb", ".usd", ".ply", ".compressed.ply", ".splat", ".spz", ".sog")
OTHER_SUFFIXES = (
    *(".htm", ".gltf", ".usda", ".usdc", ".usdz", ".obj", ".ksplat", ".json", ".safetensors"),
    *(".tif", ".tiff", ".webp", ".bmp", ".gif", ".apng", ".avif", ".heic", ".exr"),
    *(".avi", ".webm", ".mpg", ".mpeg", ".wmv", ".m4v"),
)
"""Extensions of files that Wild-GS does not write here, which are not accepted as names of new folders."""

_KNOWN = sorted(
    (*PICTURE_SUFFIXES, *VIDEO_SUFFIXES, *EXPORT_SUFFIXES, *OTHER_SUFFIXES), key=len, reverse=True
)


def file_suffix(path: Path) -> str | None:
    """The known file extension of a path, in lower case; None if there is none, or the path is a folder."""
    name = path.name.lower()
    return None if _is_folder(path) else next((known for known in _KNOWN if name.endswith(known)), None)


def names_file(path: Path, suffixes: tuple[str, ...], files: int = 1) -> bool:
    """Whether an output path is the file to be written, rather than a folder for files.

    Args:
        path: The path. An existing folder is a folder, whatever its name.
        suffixes: Extensions of the file to be written.
        files: Number of files to be written.

    Raises:
        UserError: The path has the extension of another file, several files need a folder, or there is a file where
            a folder is needed.
    """
    suffix = file_suffix(path)
    if suffix in suffixes and files == 1:
        require_folder(path.parent)
        return True
    if suffix is not None:
        if files > 1:
            raise UserError(f"{path}: {files} files are written; give a folder as --output")
        wanted = " or ".join(filter(None, (", ".join(suffixes[:-1]), suffixes[-1])))
        raise UserError(
            f"{path}: {suffix} is not what is written; let the name end in {wanted}, or give a folder as --output"
        )
    require_folder(path)
    return False


def require_folder(path: Path) -> None:
    """Raises `UserError` if a path, or a part of it, is a file, so that it cannot be a folder for files."""
    for part in (path, *path.parents):
        if is_there(part) and not _is_folder(part):
            raise UserError(f"{part} is a file; give a folder as --output, or another name")


def _is_folder(path: Path) -> bool:
    try:
        return path.is_dir()
    except (OSError, ValueError):  # a name that is too long
        return False
