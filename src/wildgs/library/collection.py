"""Records which photos the poses of `wildgs run` were computed from, to detect other photos in the same folder."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass
from pathlib import Path

from wildgs.errors import UserError
from wildgs.files import written_aside
from wildgs.sfm.upright import list_photos, scene_names

FILE = "collection.json"
NAMED = 3
"""Photos that a message names."""


@dataclass(frozen=True)
class PhotoRecord:
    """Size in bytes, time of the last change in nanoseconds, and SHA-256 of a photo."""

    size: int
    modified: int
    digest: str


@dataclass(frozen=True)
class Changes:
    """How a folder of photos differs from the collection that was recorded, by names relative to the folder."""

    added: tuple[str, ...]
    removed: tuple[str, ...]
    changed: tuple[str, ...]

    def __bool__(self) -> bool:
        return bool(self.added or self.removed or self.changed)

    def __str__(self) -> str:
        parts = []
        for label, names in (("added", self.added), ("missing", self.removed), ("changed", self.changed)):
            if names:
                more = ", ..." if len(names) > NAMED else ""
                parts.append(f"{len(names)} {label} ({', '.join(names[:NAMED])}{more})")
        return ", ".join(parts)


def photo_files(folder: Path) -> dict[str, Path]:
    """The photo files below a folder, by relative name.

    Raises:
        UserError: There is no such folder, or no photo in it.
    """
    if not folder.is_dir():
        raise UserError(f"{folder}: no such folder; give the folder that holds the photos")
    return {name: folder / name for name in list_photos(folder)}


def record_collection(photos: Path, scene: Path) -> None:
    """Writes, beside a scene, which photos it was made from; `UserError` if a photo cannot be read."""
    records = {name: asdict(_record(path)) for name, path in photo_files(photos).items()}
    with written_aside(scene / FILE) as aside:
        aside.write_text(json.dumps(records, indent=1) + "\n", encoding="utf-8")


def compare_collection(photos: Path, scene: Path) -> Changes:
    """How a folder of photos differs from those that a scene was made from.

    Contents are read only where size or time differ. Of scenes without a record, names are compared: every photo
    with a camera must be in the folder.

    Raises:
        UserError: There is no such folder, or the record cannot be read.
    """
    present = photo_files(photos)
    stored = _read(scene / FILE)
    if stored is None:
        known = set(scene_names(list(present)))
        gone = [name for name in list_photos(scene / "images") if name not in known]
        return Changes((), tuple(gone), ())
    changed = [name for name, path in present.items() if name in stored and not _same(stored[name], path)]
    return Changes(
        tuple(name for name in present if name not in stored),
        tuple(name for name in stored if name not in present),
        tuple(changed),
    )


def _read(file: Path) -> dict[str, PhotoRecord] | None:
    if not file.is_file():
        return None
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
        return {str(name): PhotoRecord(**record) for name, record in content.items()}
    except (OSError, ValueError, TypeError, AttributeError) as error:
        raise UserError(f"{file} cannot be read ({error}); delete it, or choose another --output") from error


def _same(record: PhotoRecord, path: Path) -> bool:
    status = path.stat()
    if status.st_size != record.size:
        return False
    return status.st_mtime_ns == record.modified or _digest(path) == record.digest


def _record(path: Path) -> PhotoRecord:
    try:
        status = path.stat()
        return PhotoRecord(status.st_size, status.st_mtime_ns, _digest(path))
    except OSError as error:
        raise UserError(f"{path} cannot be read ({error}); fix its permissions or take it out") from error


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
