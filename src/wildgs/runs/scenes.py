"""Compares the scene stored in a run with a scene folder."""

from __future__ import annotations

import warnings
from pathlib import Path

from wildgs.engine.checkpoint import list_checkpoints, load_header
from wildgs.errors import UserError, WildGSWarning
from wildgs.progress import Counter
from wildgs.scene import Alignment, Scene
from wildgs.scene.carried import SCENE_FILE, carry_scene
from wildgs.scene.scene_record import SceneRecord

CHECKPOINT_FOLDER = "checkpoints"


def require_same_scene(folder: Path, scene: Scene) -> None:
    """Raises `UserError` if the run in a folder was trained on another scene."""
    if (folder / SCENE_FILE).is_file():
        same = SceneRecord.read(folder / SCENE_FILE).is_of(scene)
    else:  # a run of an earlier version
        headers = [load_header(path) for path in list_checkpoints(folder / CHECKPOINT_FOLDER)]
        alignments = [Alignment.from_dict(header["alignment"]) for header in headers if "alignment" in header]
        same = all(_alike(alignment, scene.alignment) for alignment in alignments)
    if not same:
        raise UserError(
            f"{folder} was trained on another scene than {scene.root}; give that scene, or choose another --output"
        )


def _alike(one: Alignment, other: Alignment) -> bool:
    """Whether two alignments may belong to the same scene with some photos added or removed."""
    rotation = float((one.rotation - other.rotation).abs().max())
    return rotation < 0.05 and abs(one.scale / other.scale - 1) < 0.05


def adopt_scene(record: SceneRecord, found: Scene, folder: Path) -> Scene:
    """Combines the scene stored in a run with the photos of a scene folder; a warning lists differences.

    Raises:
        UserError: The folder contains another scene.
    """
    if not record.is_of(found):
        raise UserError(f"{found.root} is not the scene that {folder} was trained on; give that scene")
    scene, differences = record.adopt(found)
    if differences:
        warnings.warn(
            f"{found.root} has changed since {folder} was trained: {'; '.join(differences)}",
            WildGSWarning,
            stacklevel=3,
        )
    return scene


def carried_record(folder: Path, scene: Scene, progress: Counter | None) -> SceneRecord:
    """The scene stored in a run; stored now if an earlier version created the run."""
    require_same_scene(folder, scene)
    if not (folder / SCENE_FILE).is_file():
        carry_scene(folder, scene, progress)
    return SceneRecord.read(folder / SCENE_FILE)
