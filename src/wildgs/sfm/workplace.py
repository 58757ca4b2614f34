"""The working folder of structure from motion beside the output, which is kept if the process is killed."""

from __future__ import annotations

import hashlib
import json
import shutil
import sqlite3
import warnings
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

import filelock
import pycolmap

from wildgs.errors import UserError, WildGSWarning
from wildgs.files import is_file, read_json, written_aside
from wildgs.sfm.config import SfmConfig
from wildgs.sfm.upright import WorkingCopy, list_photos
from wildgs.version import __version__


@dataclass(frozen=True)
class Workplace:
    """Working folders and files of one reconstruction."""

    root: Path

    @property
    def images(self) -> Path:
        """The upright copies."""
        return self.root / "images"

    @property
    def masks(self) -> Path:
        """Masks of transparent pixels of the copies; missing if no photo has any."""
        return self.root / "masks"

    @property
    def database(self) -> Path:
        """Features and matches."""
        return self.root / "database.db"

    @property
    def scene(self) -> Path:
        """The finished scene before it is moved to the output."""
        return self.root / "scene"

    def fresh(self, name: str) -> Path:
        """An empty sub-folder."""
        folder = self.root / name
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        return folder

    def is_sound(self) -> bool:
        """Whether the database is intact; COLMAP does not flush it to the disk, so a power cut may damage it."""
        if not self.database.exists():
            return True
        try:
            with closing(sqlite3.connect(self.database)) as opened:
                return opened.execute("PRAGMA quick_check").fetchone() == ("ok",)
        except sqlite3.Error:
            return False

    def save_copies(self, copies: list[WorkingCopy], broken: dict[str, str]) -> None:
        """Records that all photos have been copied."""
        sizes = [_sizes(self.images), _sizes(self.masks)]
        record = {"copies": [asdict(copy) for copy in copies], "broken": broken, "sizes": sizes}
        with written_aside(self.root / "copies.json") as aside:
            aside.write_text(json.dumps(record), encoding="utf-8")

    def load_copies(self) -> tuple[list[WorkingCopy], dict[str, str]] | None:
        """The copies of an interrupted call; None if they are not complete."""
        try:
            record = read_json(self.root / "copies.json")
            if record["sizes"] != [_sizes(self.images), _sizes(self.masks)]:
                return None
            copies = [
                WorkingCopy(**{**copy, "position": copy["position"] and tuple(copy["position"])})
                for copy in record["copies"]
            ]
            return copies, record["broken"]
        except (OSError, ValueError, TypeError, KeyError):
            return None

    def is_done(self, stage: str) -> bool:
        """Whether a stage was finished by this call or an interrupted one."""
        return (self.root / f"{stage}.done").is_file()

    def set_done(self, stage: str) -> None:
        """Records that a stage was finished."""
        (self.root / f"{stage}.done").touch()

    def save_models(self, name: str, models: list[pycolmap.Reconstruction]) -> None:
        """Saves the result of a stage of mapping."""
        aside = self.fresh(f"{name}.part")
        for number, model in enumerate(models):
            (aside / str(number)).mkdir()
            model.write(aside / str(number))
        shutil.rmtree(self.root / name, ignore_errors=True)
        with written_aside(self.root / f"{name}.json") as record:
            record.write_text(json.dumps(_sizes(aside)), encoding="utf-8")
        aside.rename(self.root / name)

    def load_models(self, name: str) -> list[pycolmap.Reconstruction] | None:
        """The saved result of a stage of mapping; None if there is none."""
        folder = self.root / name
        try:
            if not folder.is_dir() or read_json(self.root / f"{name}.json") != _sizes(folder):
                return None  # COLMAP would read a truncated model as a smaller one
            return [pycolmap.Reconstruction(folder / str(n)) for n in range(len(list(folder.iterdir())))]
        except (OSError, ValueError, RuntimeError):
            return None


def _sizes(folder: Path) -> dict[str, int]:
    """Sizes of the files in a folder, to detect truncation by a full disk or a power cut."""
    return {
        path.relative_to(folder).as_posix(): path.stat().st_size
        for path in folder.rglob("*")
        if path.is_file()
    }


def work_folder(output: Path) -> Path:
    """The working folder for an output."""
    return output.parent / f".wildgs-sfm-{output.name}"


@contextmanager
def open_workplace(photos: Path, output: Path, config: SfmConfig) -> Iterator[Workplace]:
    """Opens the workplace of an output, reusing that of an interrupted call with the same photos and options.

    It is removed when the block succeeds or raises `UserError`, and kept after an interruption.

    Raises:
        UserError: Another process uses the same output.
    """
    folder = work_folder(output)
    lock = filelock.FileLock(output.parent / f"{folder.name}.lock", timeout=0)
    try:
        lock.acquire()
    except filelock.Timeout as error:
        raise UserError(
            f"{output}: another process is writing to it; wait for it, or give another folder"
        ) from error
    try:
        plan = _plan(photos, config)
        begun = folder.is_dir() and _read(folder / "plan") == plan
        if begun and not Workplace(folder).is_sound():
            begun = False
            message = f"{folder}: the results of an interrupted call are damaged; starting again"
            warnings.warn(message, WildGSWarning, stacklevel=3)
        if not begun:
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            (folder / "plan").write_text(plan, encoding="utf-8")
        try:
            yield Workplace(folder)
        except UserError:
            shutil.rmtree(folder, ignore_errors=True)
            raise
        except KeyboardInterrupt:
            message = (
                f"intermediate results are kept in {folder}; run the same command to continue, or delete it"
            )
            warnings.warn(message, WildGSWarning, stacklevel=3)
            raise
        shutil.rmtree(folder, ignore_errors=True)
    finally:
        lock.release()
        Path(lock.lock_file).unlink(missing_ok=True)


def _read(file: Path) -> str | None:
    return file.read_text(encoding="utf-8") if is_file(file) else None


def _plan(photos: Path, config: SfmConfig) -> str:
    """A digest of options, versions, and name, size and time of every photo."""
    digest = hashlib.sha256(f"{__version__} {pycolmap.__version__} {config}".encode())
    for name in list_photos(photos):
        stat = (photos / name).stat()
        digest.update(f"{name}\0{stat.st_size}\0{stat.st_mtime_ns}\0".encode(errors="surrogateescape"))
    return digest.hexdigest()
