"""The report of structure from motion: as text, and as JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

from wildgs.files import describe_names, printable, read_json
from wildgs.sfm.pairs import PairingName
from wildgs.sfm.placement import PassName, Placement

REPORT_NAME = "sfm_report.json"

PASSES: Mapping[PassName, str] = {
    "first": "matches between photos",
    "second": "matches to points of the model",
    "third": "more pairs, fewer inliers",
}

FEW_POINTS = 50
"""Median number of points per photo below which the report doubts the model."""


@dataclass(frozen=True)
class SfmReport:
    """Which photos got a pose, which did not, and why.

    Attributes:
        photos: Number of photos found.
        registered: Names in the scene of the photos with a pose.
        left_out: Likely reasons why the other photos have no pose, by name.
        renamed: Names in the scene that differ from the photo's in more than the extension, by the photo's name.
        masks: Files in the scene's `masks/` that were written with it.
        points: Number of sparse points.
        reprojection_error: Mean reprojection error of the points, pixels.
        pairing: How pairs were selected.
        pairs: Number of matched pairs.
        models: Sizes of all models, largest first; the first is kept.
        seconds: Computing time.
        other_places: Groups of photos without a pose that show another place, or another side of this one, largest
            first.
        placed: Reliability of each pose, by name in the scene.
        copies: Originals of copies and crops, by name.
        doubtful: Reasons why poses are doubtful, by name.
        pictures: Image files of the best matches of photos without a pose, by name.
        edited: How photos were cropped or stretched, which their cameras take into account, by name in the scene.
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
    other_places: tuple[tuple[str, ...], ...] = ()
    renamed: Mapping[str, str] = field(default_factory=dict)
    masks: tuple[str, ...] = ()
    placed: Mapping[str, Placement] = field(default_factory=dict)
    copies: Mapping[str, str] = field(default_factory=dict)
    doubtful: Mapping[str, str] = field(default_factory=dict)
    pictures: Mapping[str, str] = field(default_factory=dict)
    edited: Mapping[str, str] = field(default_factory=dict)

    def lines(self) -> list[str]:
        """The report as text."""
        text = [
            f"{len(self.registered)} of {self.photos} photos registered, {self.points} points,"
            f" {self.reprojection_error:.2f} px mean reprojection error"
            f" ({self.pairs} pairs, {self.pairing}, {self.seconds:.0f} s)"
        ]
        for name, how in PASSES.items():
            placed = [photo for photo, placement in self.placed.items() if placement.placed_by == name]
            if placed and name != "first":
                text.append(f"{len(placed)} of them by the {name} pass ({how}): {_some(placed)}")
        if self.placed:
            typical = int(median(placement.points for placement in self.placed.values()))
            if typical < FEW_POINTS:
                text.append(
                    f"half of the photos observe no more than {typical} of the points, so that poses may be wrong;"
                    " add photos that overlap more, taken in between"
                )
        if self.copies:
            text.append(
                f"{len(self.copies)} photos are copies or crops of others: {_some(sorted(self.copies))}"
            )
        if self.edited:
            text.append(
                f"{len(self.edited)} of the photos with a pose were cropped or stretched, which their cameras take"
                f" into account: {_some(sorted(self.edited))} ({REPORT_NAME} says how)"
            )
        if self.doubtful:
            text.append(f"{len(self.doubtful)} poses are doubtful (wrong, or photos of look-alikes):")
            text += [f"  {printable(name)}: {why}" for name, why in sorted(self.doubtful.items())]
        if self.left_out:
            text.append(
                f"{len(self.left_out)} photos have no pose and are not used; the others are not affected:"
            )
            grouped = {name for group in self.other_places for name in group}
            text += [
                f"  {len(group)} photos form another place, or another side of this one: {_some(group)};"
                " reconstruct them in a folder of their own, or add photos taken in between"
                for group in self.other_places
            ]
            text += [
                f"  {printable(name)}: {reason}"
                for name, reason in sorted(self.left_out.items())
                if name not in grouped
            ]
        if self.renamed:
            text.append(f"{len(self.renamed)} photos have other names in the scene:")
            text += [f"  {printable(name)}: {renamed}" for name, renamed in sorted(self.renamed.items())]
        return text

    def write(self, folder: Path) -> None:
        """Writes the report as `sfm_report.json`."""
        text = json.dumps(asdict(self), indent=2, ensure_ascii=False)
        # Bytes that are not UTF-8 are written as JSON escapes.
        (folder / REPORT_NAME).write_text(text + "\n", encoding="utf-8", errors="backslashreplace")


def _some(names: Sequence[str]) -> str:
    return describe_names([printable(name) for name in names])


def read_masks(folder: Path) -> list[str]:
    """The masks listed in an earlier report; none if there is no report or no list."""
    masks = _read(folder).get("masks", [])
    return [str(name) for name in masks] if isinstance(masks, list) else []


@dataclass(frozen=True)
class LeftOutPhoto:
    """A photo without a pose, the reason, and the image of its best matches, if there is one."""

    name: str
    reason: str
    picture: Path | None


def read_left_out(folder: Path) -> list[LeftOutPhoto]:
    """The photos without a pose in the report of a scene."""
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
    """A summary of how the photos of a scene were registered; empty without a report."""
    record = _read(folder)
    try:
        placed, doubtful = record["placed"], record.get("doubtful", {})
        later = sum(how["placed_by"] != "first" for how in placed.values())
        weakest = sorted(placed, key=lambda name: placed[name]["points"])[:3]
        least = ", ".join(f"{printable(name)} ({placed[name]['points']} points)" for name in weakest)
    except (KeyError, TypeError, AttributeError):  # report of an earlier version, or damaged
        return ""
    if not placed:
        return ""
    return (
        f"{len(placed)} photos have a pose, {later} of them by the second or third pass; {len(doubtful)} are"
        f" doubtful. Least reliable: {least}."
    )


def _read(folder: Path) -> dict[str, Any]:
    try:
        record = read_json(folder / REPORT_NAME)
    except (OSError, ValueError):
        return {}
    return record if isinstance(record, dict) else {}
