"""Run folders, which training writes and all other commands read."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import filelock
import torch
from torch import Tensor

from wildgs.config import RunConfig, edited_entries
from wildgs.config_file import CONFIG_FILE, read_config, write_config
from wildgs.engine.checkpoint import Checkpoint, list_checkpoints, load_newest, save_checkpoint
from wildgs.engine.team import Team
from wildgs.engine.trainer import Trainer
from wildgs.errors import UserError, WildGSWarning
from wildgs.files import is_there
from wildgs.model.method import Method
from wildgs.model.registry import create_method, restore_method
from wildgs.plain_values import to_plain
from wildgs.progress import Counter
from wildgs.runs.scenes import CHECKPOINT_FOLDER, adopt_scene, carried_record, require_same_scene
from wildgs.scene import Alignment, Scene, load_scene
from wildgs.scene.carried import LIGHTS_FOLDER, SCENE_FILE, carry_scene, read_carried_scene
from wildgs.scene.scene_record import SceneRecord

LOCK_FILE = ".lock"
WRITTEN = (SCENE_FILE, LIGHTS_FOLDER, "metrics.jsonl", "photos.json", "eval")
"""Files and folders that training or scoring a run would overwrite."""


def default_device() -> torch.device:
    """CUDA if available, else the CPU."""
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


@dataclass(frozen=True)
class Run:
    """A trained run, as loaded from its folder.

    Attributes:
        folder: The run folder.
        config: Its configuration.
        method: The trained method.
        step: Number of steps done.
        train_seconds: Training time.
        alignment: Transform from the COLMAP model's frame to the aligned frame.
    """

    folder: Path
    config: RunConfig
    method: Method
    step: int
    train_seconds: float
    alignment: Alignment

    @cached_property
    def scene(self) -> Scene:
        """The scene as stored in the run folder: cameras, points, alignment, split, and photos on demand.

        Photos have their cameras' size but are copies of limited detail (`CarriedPhotos.detail`), sufficient for
        embedding and display but not for scoring or training (see `read_scene`). For runs of earlier versions,
        which do not contain their scene, the scene folder is read.

        Raises:
            UserError: The stored scene cannot be read; or there is none, and the scene folder does not exist.
        """
        carried = read_carried_scene(self.folder)
        if carried is not None:
            return carried
        root = self._scene_folder(None)
        return load_scene(root, self.config.data, alignment=self.alignment, lazy=True)

    def read_scene(self, root: Path | None = None, progress: Counter | None = None) -> Scene:
        """Reads the scene with its original photos, masks, depth maps and ground truth from the scene folder.

        Cameras, split, points and alignment are those stored in the run, so that later changes of the scene folder
        do not affect scores; a warning lists the differences.

        Args:
            root: The scene folder; None takes the one on which the run was trained.
            progress: Called with (photos read, total number of photos).

        Raises:
            UserError: The folder is missing, cannot be read, or contains another scene.
        """
        root = self._scene_folder(root)
        found = load_scene(root, self.config.data, alignment=self.alignment, progress=progress)
        if not is_there(self.folder / SCENE_FILE):
            return found
        return adopt_scene(SceneRecord.read(self.folder / SCENE_FILE), found, self.folder)

    def _scene_folder(self, root: Path | None) -> Path:
        root = root or self.config.scene
        if not root.is_dir():
            raise UserError(
                f"{root}: no such folder, but {self.folder} was trained on its photos: give their current "
                "folder with `wildgs eval --scene`; a run of an earlier version stores copies when it is resumed "
                f"(`wildgs train SCENE --output {self.folder} --resume`)"
            )
        return root


def load_run(folder: Path, device: torch.device | None = None) -> Run:
    """Loads the newest checkpoint of a run.

    Raises:
        UserError: The folder is not a run folder, or has no checkpoint yet.
    """
    if not (folder / CONFIG_FILE).is_file():
        raise UserError(
            f"{folder} is not a run folder (no {CONFIG_FILE}); make one with `wildgs train SCENE`"
        )
    config = read_config(folder / CONFIG_FILE)
    checkpoint = newest_checkpoint(folder)
    if checkpoint is None:
        raise UserError(f"{folder} has no checkpoint yet; let `wildgs train` finish or resume it")
    if changes := edited_entries(config, checkpoint.header.get("config")):
        warnings.warn(
            f"{folder / CONFIG_FILE} was changed after training ({changes}); the changed configuration is used",
            WildGSWarning,
            stacklevel=2,
        )
    method = restore_method(config.method, config.model, checkpoint.method)
    with _complete(folder):
        return Run(
            folder=folder,
            config=config,
            method=method.to(device or default_device()).eval(),
            step=int(checkpoint.state["progress.step"]),
            train_seconds=float(checkpoint.state["progress.seconds"]),
            alignment=Alignment.from_dict(checkpoint.header["alignment"]),
        )


@contextmanager
def _complete(folder: Path) -> Iterator[None]:
    """Raises `UserError` if entries of a checkpoint are missing: it was not written by this version."""
    try:
        yield
    except (KeyError, IndexError, TypeError, ValueError, RuntimeError) as error:
        first = (str(error).splitlines() or [""])[0]
        raise UserError(
            f"{folder}: its checkpoint was not written by this version ({type(error).__name__}: {first})"
        ) from error


@contextmanager
def holding(lock_file: Path) -> Iterator[bool | None]:
    """Tries to lock a file for the duration of the block; the lock ends with the process.

    Yields:
        Whether this process holds the lock; None on a file system without locks, such as some network disks.

    Raises:
        UserError: The folder cannot be written to.
    """
    lock = filelock.FileLock(lock_file, timeout=0)
    held: bool | None = True
    try:
        lock_file.parent.mkdir(parents=True, exist_ok=True)
        lock.acquire()
    except filelock.Timeout:
        held = False
    except NotImplementedError:
        held = None
    except OSError as error:
        raise UserError(
            f"{lock_file.parent} cannot be written to ({error}); choose another --output"
        ) from error
    try:
        yield held
    finally:
        lock.release()


@contextmanager
def lock_run(folder: Path) -> Iterator[None]:
    """Locks a run folder against other processes for the duration of the block.

    If the block wrote nothing, the folder is afterwards as it was before, or gone if it is new.

    Raises:
        UserError: Another process uses the folder, or it cannot be written to.
    """
    is_new = not folder.exists()
    with holding(folder / LOCK_FILE) as held:
        if held is None:
            message = f"{folder} is on a file system without locks: do not start a second training in it"
            warnings.warn(message, WildGSWarning, stacklevel=3)
        elif not held:
            raise UserError(
                f"{folder} is in use by another training; wait for it or stop it, or choose another --output"
            )
        try:
            yield
        finally:
            with suppress(OSError):
                if [file.name for file in folder.iterdir()] == [LOCK_FILE]:
                    (folder / LOCK_FILE).unlink()
                    if is_new:
                        folder.rmdir()


def newest_checkpoint(folder: Path, *, set_aside: bool = False) -> Checkpoint | None:
    """The newest undamaged checkpoint of a run folder, or None; see `load_newest`."""
    return load_newest(folder / CHECKPOINT_FOLDER, set_aside=set_aside)


def refuse_trained(folder: Path) -> None:
    """Raises `UserError` if a folder already contains a run or files that a run would overwrite."""
    checkpoints = folder / CHECKPOINT_FOLDER
    if checkpoints.exists() and not checkpoints.is_dir():
        raise UserError(f"{checkpoints} is not a folder: move it away, or choose another --output")
    if list_checkpoints(checkpoints):
        raise UserError(f"{folder} already holds a run; add --resume to continue, or choose another --output")
    if not (folder / CONFIG_FILE).exists():
        for name in WRITTEN:
            if (folder / name).exists():
                raise UserError(
                    f"{folder / name} belongs to no run; move it away, or choose another --output"
                )


def prepare_training(
    folder: Path,
    config: RunConfig,
    scene: Scene,
    *,
    resume: bool,
    team: Team | None = None,
    progress: Counter | None = None,
) -> Trainer:
    """Creates a trainer at step 0, or at the newest undamaged checkpoint of a run.

    Only rank 0 reads and writes the run folder.

    Args:
        folder: The run folder.
        config: Configuration of the run. When resuming, its upper bound on Gaussians may be lower than before.
        scene: The scene to train on.
        resume: Whether to resume a run.
        team: The processes that train the run.
        progress: Called with (photos copied, total number of photos) while photos are copied to the run folder.

    Raises:
        UserError: See `start_training` and `resume_training`.
    """
    if not resume:
        return start_training(folder, config, scene, team=team, progress=progress)
    team = team or Team()
    team.from_first(lambda: require_same_scene(folder, scene))
    stored = team.from_first(lambda: read_config(folder / CONFIG_FILE))
    if to_plain(config) != to_plain(stored):  # the scene may have moved
        team.from_first(lambda: write_config(folder / CONFIG_FILE, config))
    trainer = resume_training(folder, scene, team=team, progress=progress)
    if config.train.density.max_gaussians < stored.train.density.max_gaussians and trainer.shrink_to_budget():
        # Saved at once, so that a run killed before the next checkpoint resumes from this state.
        team.from_first(lambda: save_run(folder, trainer, config, scene.alignment))
    return trainer


def start_training(
    folder: Path,
    config: RunConfig,
    scene: Scene,
    device: torch.device | None = None,
    team: Team | None = None,
    progress: Counter | None = None,
) -> Trainer:
    """Creates a trainer at step 0; writes the configuration and a copy of the scene to the run folder.

    Raises:
        UserError: The folder already contains a trained run.
    """
    team = team or Team()
    team.from_first(lambda: _create_run_folder(folder, config, scene, progress))
    device = device or default_device()
    # The trainer stores the generators' states; those of the process are restored.
    with team.propagate_errors(), torch.random.fork_rng([device] if device.type == "cuda" else []):
        torch.manual_seed(config.train.seed)
        budget = config.train.density.max_gaussians
        method = create_method(
            config.method, config.model, scene, max_gaussians=budget, seed=config.train.seed
        )
        return Trainer(method.to(device), scene, config.train, team)


def _create_run_folder(folder: Path, config: RunConfig, scene: Scene, progress: Counter | None) -> None:
    refuse_trained(folder)
    folder.mkdir(parents=True, exist_ok=True)
    write_config(folder / CONFIG_FILE, config)
    carry_scene(folder, scene, progress)


def resume_training(
    folder: Path,
    scene: Scene,
    device: torch.device | None = None,
    team: Team | None = None,
    progress: Counter | None = None,
) -> Trainer:
    """Creates a trainer at the newest undamaged checkpoint, with the run's configuration.

    A run without checkpoints starts at step 0. Cameras, split, points and alignment are those stored in the run; a
    run of an earlier version stores them now.

    Raises:
        UserError: The folder is not a run folder, all checkpoints are damaged, or the run is of another scene.
    """
    team = team or Team()
    config = team.from_first(lambda: read_config(folder / CONFIG_FILE))
    checkpoint = team.from_first(lambda: newest_checkpoint(folder, set_aside=True))
    if checkpoint is None:
        return start_training(folder, config, scene, device, team, progress)
    team.from_first(lambda: _refuse_edited(folder, config, checkpoint))
    record = team.from_first(lambda: carried_record(folder, scene, progress))
    with team.propagate_errors(), _complete(folder):
        method = restore_method(config.method, config.model, checkpoint.method)
        scene = adopt_scene(record, scene, folder)
        trainer = Trainer(method.to(device or default_device()), scene, config.train, team)
        trainer.restore(checkpoint.state)
    return trainer


def _refuse_edited(folder: Path, config: RunConfig, checkpoint: Checkpoint) -> None:
    if changes := edited_entries(config, checkpoint.header.get("config")):
        raise UserError(
            f"{folder / CONFIG_FILE} was changed after training began ({changes}); undo the change, or start a new "
            "run in another --output"
        )


def save_run(folder: Path, trainer: Trainer, config: RunConfig, alignment: Alignment) -> Path:
    """Writes a checkpoint of a run; raises `UserError` if it cannot be written."""
    return save_checkpoint(folder / CHECKPOINT_FOLDER, *run_state(trainer, config, alignment))


def run_state(
    trainer: Trainer, config: RunConfig, alignment: Alignment
) -> tuple[int, dict[str, Tensor], dict[str, Any]]:
    """Content of a checkpoint: step, tensors and header."""
    header: dict[str, Any] = {"config": to_plain(config), "alignment": alignment.to_dict()}
    return trainer.step, trainer.state(), header
