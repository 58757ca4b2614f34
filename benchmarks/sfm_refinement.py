"""Scenes with the cameras that structure from motion has before and after its last adjustments, to train on each.

    python benchmarks/sfm_refinement.py ../shared/data/temple/images OUT
    python benchmarks/sfm_refinement.py ../shared/data/gate/images OUT --photos 34 --choice 1
    wildgs train OUT/before --output BEFORE --steps 1500 --downscale 2 --density.max-gaussians 40000

`OUT/before`, `OUT/detected` and `OUT/after` have the same photos, so that training holds out the same ones; in the
second one, features are where they were detected instead of where photos show the same. Photos to which only the
last adjustments gave a pose are in none. A line is printed for each: photos, points, observations, reprojection
error, and the share of the verified matches that agree with the cameras (closer than a pixel of 500).
"""

from __future__ import annotations

import shutil
import tempfile
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import tyro

import wildgs
from wildgs.errors import UserError, WildGSWarning
from wildgs.sfm import reconstruction, refinement, registration
from wildgs.sfm.config import SfmConfig
from wildgs.sfm.lookalikes import count_agreeing
from wildgs.sfm.upright import WorkingCopy, list_photos
from wildgs.sfm.workplace import Workplace


@dataclass(frozen=True)
class Command:
    """Writes three scenes of a folder of photos."""

    photos_folder: tyro.conf.Positional[Path]
    """Folder of photos."""
    output: tyro.conf.Positional[Path]
    """Folder for the scenes."""
    photos: int | None = None
    """Number of photos chosen at random; None for all."""
    choice: int = 1
    """Seed of the choice of photos."""
    seed: int = 0
    """Seed of structure from motion."""


class Kept:
    """Writes the scene before and after the first call of `refine` during `wildgs.reconstruct`."""

    def __init__(self, output: Path) -> None:
        self._output, self._refine, self._find = output, registration.refine, reconstruction.find_poses
        self._copies: list[WorkingCopy] = []
        registration.refine, reconstruction.find_poses = self._keep, self._note

    def _note(self, work: Workplace, copies: list[WorkingCopy], *rest: Any) -> Any:
        self._copies = copies
        return self._find(work, copies, *rest)

    def _keep(self, work: Workplace, model: Any, *rest: Any) -> Any:
        refined = self._refine(work, model, *rest)
        if not (self._output / "before").exists():
            move, refinement.refine_keypoints = (
                refinement.refine_keypoints,
                lambda work, model, *_: (model, set()),
            )
            detected = self._refine(work, model, *rest)
            refinement.refine_keypoints = move
            for name, each in (("before", model), ("detected", detected), ("after", refined)):
                self._write(work, each, name)
        return refined

    def _write(self, work: Workplace, model: Any, name: str) -> None:
        reconstruction._write_scene(work, self._copies, model)
        shutil.copytree(work.scene, self._output / name)
        agreeing, matches = count_agreeing(model, work.database)
        print(
            f"{name}: {model.num_reg_images()} photos, {model.num_points3D()} points,"
            f" {model.compute_num_observations()} observations, {model.compute_mean_reprojection_error():.2f} px,"
            f" {agreeing / max(matches, 1):.3f} of the matches agree",
            flush=True,
        )


def main(command: Command) -> None:
    """Writes the scenes and prints a line for each."""
    if command.output.exists():
        raise UserError(f"{command.output}: exists; give another folder")
    warnings.simplefilter("ignore", WildGSWarning)
    names = list_photos(command.photos_folder)
    if command.photos is not None:
        random = np.random.default_rng(command.choice)
        rows = random.choice(len(names), min(command.photos, len(names)), replace=False)
        names = [names[row] for row in sorted(rows)]
    pycolmap.logging.minloglevel = 3
    Kept(command.output)
    with tempfile.TemporaryDirectory() as folder:
        photos = Path(folder) / "photos"
        for name in names:
            (photos / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(command.photos_folder / name, photos / name)
        wildgs.reconstruct(photos, Path(folder) / "scene", SfmConfig(seed=command.seed))


if __name__ == "__main__":
    main(tyro.cli(Command))
