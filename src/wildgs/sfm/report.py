"""The result of structure from motion on a folder of photos, for people and for programs."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from wildgs.files import printable, read_json
from wildgs.scene.colmap import describe_names
from wildgs.sfm.pairs import PairingName
from wildgs.sfm.placement import Placement

REPORT_NAME = "sfm_report.json"


@dataclass(frozen=True)
class SfmReport:
    """Which photos got a pose, which did not, and why.

    Attributes:
        photos: Number of photos found.
        registered: Names in the scene of the photos with a pose.
        left_out: From the names of the other photos to the likely reason.
        renamed: From the names of photos to their names in the scene, where these differ in more than the ending.
        masks: Files in the scene's `masks/` that were written with it.
        points: Number of sparse points.
        reprojection_error: Mean over the points, pixels.
        pairing: How the pairs to match were chosen.
        pairs: How many pairs were matched.
        models: Sizes of all models found, largest first; the first is kept.
        seconds: Time taken.
        placed: How sure each pose is, by name in the scene.
        copies: From copies and crops of a photo to the photo.
        doubtful: From the names of photos with a pose to what contradicts it.
        pictures: From the names of photos without a pose to pictures of their best matches, files of the scene.
    """

    photos: int
    registered: tuple[str, ...]
    left_out: Mapping[str, str]
    points: int
    reprojection_error: float
    pairing: PairingName
    pairs: int
    models: tuple[int, ...]
    seconds: float
    renamed: Mapping[str, str] = field(default_factory=dict)
    masks: tuple[str, ...] = ()
    placed: Mapping[str, Placement] = field(default_factory=dict)
    copies: Mapping[str, str] = field(default_factory=dict)
    doubtful: Mapping[str, str] = field(default_factory=dict)
    pictures: Mapping[str, str] = field(default_factory=dict)

    def lines(self) -> list[str]:
        """The report in plain sentences."""
        text = [
            f"{len(self.registered)} of {self.photos} photos registered, {self.points} points,"
            f" {self.reprojection_error:.2f} px mean reprojection error"
            f" ({self.pairs} pairs, {self.pairing}, {self.seconds:.0f} s)"
        ]
        later = [name for name, how in self.placed.items() if how.placed_by != "first"]
        if later:
            text.append(f"{len(later)} of them at a second or third chance: {_some(later)}")
        if self.copies:
            text.append(
                f"{len(self.copies)} photos are copies or crops of others: {_some(sorted(self.copies))}"
            )
        if self.doubtful:
            text.append(f"{len(self.doubtful)} poses are doubtful (look-alikes, or wrong):")
            text += [f"  {printable(name)}: {why}" for name, why in sorted(self.doubtful.items())]
        if self.left_out:
            text.append(
                f"{len(self.left_out)} photos have no pose and take no part; the others are not affected:"
            )
            text += [f"  {printable(name)}: {reason}" for name, reason in sorted(self.left_out.items())]
        if self.renamed:
            text.append(f"{len(self.renamed)} photos have other names in the scene:")
            text += [f"  {printable(name)}: {renamed}" for name, renamed in sorted(self.renamed.items())]
        return text

    def write(self, folder: Path) -> None:
        """Write the report as `sfm_report.json`."""
        text = json.dumps(asdict(self), indent=2, ensure_ascii=False)
        # Bytes that are not UTF-8 become JSON's own escapes, from which `read` gets them back.
        (folder / REPORT_NAME).write_text(text + "\n", encoding="utf-8", errors="backslashreplace")


def _some(names: Sequence[str]) -> str:
    return describe_names([printable(name) for name in names])


def read_masks(folder: Path) -> list[str]:
    """The masks that an earlier report lists; none if there is no report, or an older one without the list."""
    masks = _read(folder).get("masks", [])
    return [str(name) for name in masks] if isinstance(masks, list) else []


@dataclass(frozen=True)
class LeftOutPhoto:
    """A photo without a pose, the reason, and the picture of its best matches, where there is one."""

    name: str
    reason: str
    picture: Path | None


def read_left_out(folder: Path) -> list[LeftOutPhoto]:
    """The photos without a pose that the report of a scene lists, with their pictures."""
    record = _read(folder)
    reasons, pictures = record.get("left_out", {}), record.get("pictures", {})
    if not isinstance(reasons, dict) or not isinstance(pictures, dict):
        return []
    files = {name: folder / str(picture) for name, picture in pictures.items()}
    return [
        LeftOutPhoto(name, str(reason), files[name] if name in files and files[name].is_file() else None)
        for name, reason in sorted(reasons.items())
    ]


def describe_placed(folder: Path) -> str:
    """A sentence on how the photos of a scene were placed, empty where its report does not say."""
    record = _read(folder)
    try:
        placed, doubtful = record["placed"], record.get("doubtful", {})
        later = sum(how["placed_by"] != "first" for how in placed.values())
        weakest = sorted(placed, key=lambda name: placed[name]["points"])[:3]
        least = ", ".join(f"{printable(name)} ({placed[name]['points']} points)" for name in weakest)
    except (KeyError, TypeError, AttributeError):  # of an earlier version, or damaged
        return ""
    if not placed:
        return ""
    return (
        f"{len(placed)} photos have a pose, {later} of them by a second or third chance; {len(doubtful)} are"
        f" doubtful. The least sure: {least}."
    )


def _read(folder: Path) -> dict[str, Any]:
    try:
        record = read_json(folder / REPORT_NAME)
    except (OSError, ValueError):
        return {}
    return record if isinstance(record, dict) else {}
