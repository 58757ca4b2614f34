"""What structure from motion made of a folder of photos, for people and for programs."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

from wildgs.sfm.pairs import PairingName

REPORT_NAME = "sfm_report.json"


@dataclass(frozen=True)
class SfmReport:
    """Which photos got a pose, which did not, and why.

    Attributes:
        photos: Number of photos found.
        registered: Names in the scene of the photos with a pose.
        left_out: From the names of the other photos to the likely reason.
        points: Number of sparse points.
        reprojection_error: Mean over the points, pixels.
        pairing: How the pairs to match were chosen.
        pairs: How many pairs were matched.
        models: Sizes of all models found, largest first; the first is kept.
        seconds: Time taken.
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

    def lines(self) -> list[str]:
        """The report in plain sentences."""
        text = [
            f"{len(self.registered)} of {self.photos} photos registered, {self.points} points,"
            f" {self.reprojection_error:.2f} px mean reprojection error"
            f" ({self.pairs} pairs, {self.pairing}, {self.seconds:.0f} s)"
        ]
        if self.left_out:
            text.append(
                f"{len(self.left_out)} photos have no pose and take no part; the others are not affected:"
            )
            text += [f"  {name}: {reason}" for name, reason in sorted(self.left_out.items())]
        return text

    def write(self, folder: Path) -> None:
        """Write the report as `sfm_report.json`."""
        text = json.dumps(asdict(self), indent=2, ensure_ascii=False)
        (folder / REPORT_NAME).write_text(text + "\n", encoding="utf-8")
