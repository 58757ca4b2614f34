"""Compares the scene that a run carries with the scene folder that it is used with."""

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
            f"{folder} was trained on another scene than {scene.root}; give the scene that it was trained on, "
            "or choose another --output"
        )


def _alike(one: Alignment, other: Alignment) -> bool:
    """Whether two alignments may be of one scene, with some photos more or less."""
    rotation = float((one.rotation - other.rotation).abs().max())
    return rotation < 0.05 and abs(one.scale / other.scale - 1) < 0.05


def adopt_scene(record: SceneRecord, found: Scene, folder: Path) -> Scene:
    """The run's own scene with the photos of a folder; one warning says what differs.

    Raises:
        UserError: The folder holds another scene.
    """
    if not record.is_of(found):
        raise UserError(f"{found.root} is another scene than the one that {folder} was trained on")
    scene, differences = record.adopt(found)
    if differences:
        warnings.warn(
            f"{found.root} is not as it was when {folder} was trained: {'; '.join(differences)}",
            WildGSWarning,
            stacklevel=3,
        )
    return scene


def carried_record(folder: Path, scene: Scene, progress: Counter | None) -> SceneRecord:
    """What the run carries of its scene; written first where an earlier version began the run."""
    require_same_scene(folder, scene)
    if not (folder / SCENE_FILE).is_file():
        carry_scene(folder, scene, progress)
    return SceneRecord.read(folder / SCENE_FILE)
