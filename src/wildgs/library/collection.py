"""Records the photos and options from which `wildgs run` computed poses, to detect later changes."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass
from pathlib import Path

from wildgs.errors import UserError
from wildgs.files import is_there, read_json, written_aside
from wildgs.sfm.config import SfmConfig
from wildgs.sfm.upright import list_photos, scene_names

FILE = "collection.json"
NAMED = 3
"""Number of photos that a message names."""


@dataclass(frozen=True)
class PhotoRecord:
    """Size in bytes, modification time in nanoseconds, and SHA-256 of a photo."""

    size: int
    modified: int
    digest: str


@dataclass(frozen=True)
class Changes:
    """Differences between a folder of photos and the record, as names relative to the folder."""

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
    """The photo files in a folder and its sub-folders, by relative name.

    Raises:
        UserError: The folder does not exist or contains no photos.
    """
    if not folder.is_dir():
        raise UserError(f"{folder}: no such folder; give the folder that holds the photos")
    return {name: folder / name for name in list_photos(folder)}


def record_collection(photos: Path, scene: Path, sfm: SfmConfig) -> None:
    """Writes into a scene folder from which photos and with which options it was made.

    Raises:
        UserError: A photo cannot be read, or the file cannot be written.
    """
    records = {name: asdict(_record(path)) for name, path in photo_files(photos).items()}
    content = {"sfm": _plain(sfm), "photos": records}
    with written_aside(scene / FILE) as aside:
        aside.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def compare_collection(photos: Path, scene: Path) -> Changes:
    """Compares a folder of photos with those that a scene was made from.

    A file is hashed only if its time has changed. For a scene without a record, every photo of the scene must be in
    the folder by name.

    Raises:
        UserError: The folder does not exist, or the record cannot be read.
    """
    present = photo_files(photos)
    stored = _read(scene / FILE)[0]
    if stored is None:
        names = set(scene_names(list(present)))
        missing = [name for name in list_photos(scene / "images") if name not in names]
        return Changes((), tuple(missing), ())
    changed = [name for name, path in present.items() if name in stored and not _same(stored[name], path)]
    return Changes(
        tuple(name for name in present if name not in stored),
        tuple(name for name in stored if name not in present),
        tuple(changed),
    )


def changed_options(scene: Path, sfm: SfmConfig) -> str:
    """Describes options that are neither the default nor those a scene was made with; empty if there are none.

    Raises:
        UserError: The record cannot be read.
    """
    stored, defaults = _read(scene / FILE)[1], _plain(SfmConfig())
    return ", ".join(
        f"--{name.replace('_', '-')} was {stored[name]}, not {value}"
        for name, value in _plain(sfm).items()
        if name in stored and value not in (stored[name], defaults[name])
    )


def _plain(sfm: SfmConfig) -> dict[str, object]:
    """Options that affect the poses, without nesting."""
    plain = asdict(sfm)
    return {name: value for name, value in (plain.pop("pairing") | plain).items() if name != "threads"}


def _read(file: Path) -> tuple[dict[str, PhotoRecord] | None, dict[str, object]]:
    """The recorded photos and options; (None, {}) if there is no record."""
    if not is_there(file):
        return None, {}
    try:
        content = read_json(file)
        records = {str(name): PhotoRecord(**record) for name, record in content["photos"].items()}
        return records, dict(content["sfm"])
    except (OSError, ValueError, TypeError, AttributeError, KeyError) as error:
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
        raise UserError(f"{path} cannot be read ({error}); fix its permissions or remove it") from error


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
