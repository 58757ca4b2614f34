"""Packs a scene folder into the archive that ships with the package, and compares the two."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np
from PIL import Image

_DATE = (2024, 1, 1, 0, 0, 0)  # of every entry, so that equal folders give equal archives
_PICTURES = {".jpg", ".png"}


def pack(folder: Path, archive: Path) -> None:
    """Writes all files of a folder into an archive: pictures uncompressed, everything else deflated."""
    with zipfile.ZipFile(archive, "w") as target:
        for file in sorted(path for path in folder.rglob("*") if path.is_file()):
            entry = zipfile.ZipInfo(file.relative_to(folder).as_posix(), _DATE)
            entry.external_attr = 0o644 << 16
            method = zipfile.ZIP_STORED if file.suffix in _PICTURES else zipfile.ZIP_DEFLATED
            target.writestr(entry, file.read_bytes(), method, compresslevel=9)


def share_of_differences(folder: Path, archive: Path) -> dict[str, float]:
    """Compares each file of a folder with the archive's entry of the same name.

    Pictures are compared by their decoded values and their EXIF blocks, because encoders differ between versions of
    a library, and everything else by its bytes. A picture of another shape or with a block of another length, and a
    file that the archive lacks, differ in full.

    Args:
        folder: A scene folder, or a part of one.
        archive: As `pack` wrote it.

    Returns:
        From each file's name to the share of its values that differ, 0 to 1.
    """
    differences = {}
    with zipfile.ZipFile(archive) as source:
        stored = set(source.namelist())
        for file in sorted(path for path in folder.rglob("*") if path.is_file()):
            name = file.relative_to(folder).as_posix()
            if name not in stored:
                differences[name] = 1.0
                continue
            ours, theirs = _values(file.suffix, file.read_bytes()), _values(file.suffix, source.read(name))
            same_shape = ours.shape == theirs.shape
            differences[name] = float(np.mean(ours != theirs)) if same_shape else 1.0
    return differences


def _values(suffix: str, data: bytes) -> np.ndarray:
    if suffix not in _PICTURES:
        return np.frombuffer(data, dtype=np.uint8)
    with Image.open(io.BytesIO(data)) as picture:
        pixels, block = np.asarray(picture), np.frombuffer(picture.info.get("exif", b""), dtype=np.uint8)
    return np.concatenate([np.array(pixels.shape), pixels.ravel(), block])
