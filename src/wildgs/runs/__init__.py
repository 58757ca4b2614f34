"""Run folders: what training writes and all other commands read."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import filelock
import torch
from torch import Tensor

from wildgs.config import RunConfig, edited_entries, read_config, to_plain, write_config
from wildgs.engine.checkpoint import Checkpoint, list_checkpoints, load_newest, save_checkpoint
from wildgs.engine.team import Team
from wildgs.engine.trainer import Trainer
from wildgs.errors import UserError, WildGSWarning
from wildgs.files import is_there
from wildgs.model.method import Method
from wildgs.model.registry import create_method, restore_method
from wildgs.progress import Counter
from wildgs.runs.scenes import CHECKPOINT_FOLDER, adopt_scene, carried_record, require_same_scene
from wildgs.scene import Alignment, Scene, load_scene
from wildgs.scene.carried import SCENE_FILE, carry_scene, read_carried_scene
from wildgs.scene.scene_record import SceneRecord

CONFIG_FILE = "config.yaml"
LOCK_FILE = ".lock"


def default_device() -> torch.device:
    """CUDA where torch has it, else the CPU."""
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


@dataclass(frozen=True)
class Run:
    """A trained run, as loaded from its folder.

    Attributes:
        folder: The run folder.
        config: Its configuration.
        method: The trained method.
        step: Steps done.
        train_seconds: Training time.
        alignment: From the input's frame to the scene's.
    """

    folder: Path
    config: RunConfig
    method: Method
    step: int
    train_seconds: float
    alignment: Alignment

    @cached_property
    def scene(self) -> Scene:
        """The scene as the run folder carries it: cameras, points, alignment, split, and photos on demand.

        Its photos are copies, as large as their cameras but of no more detail than `CarriedPhotos.detail`: enough
        to read their light and to show them, not to score against or to train on (`read_scene` is for that). Runs
        of earlier versions carry no scene; theirs is read from the scene folder.

        Raises:
            UserError: What the run carries cannot be read; or it carries nothing, and its scene folder is gone.
        """
        carried = read_carried_scene(self.folder)
        if carried is not None:
            return carried
        root = self._scene_folder(None)
        return load_scene(root, self.config.data, alignment=self.alignment, lazy=True)

    def read_scene(self, root: Path | None = None, progress: Counter | None = None) -> Scene:
        """The scene with its full photos, masks, depth priors and truth, from its folder.

        Cameras, split, points and alignment are the run's own, so that a scene folder that changed since changes no
        score silently: one warning says what differs.

        Args:
            root: The scene folder; None takes the one on which the run was trained.
            progress: Called with (photos read, photos in all).

        Raises:
            UserError: The folder is missing, cannot be read, or holds another scene.
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
                f"{root}: no such folder; {self.folder} was trained on the photos there: give `wildgs eval` the "
                "folder where they are now by --scene; a run of an earlier version carries them once it is resumed "
                f"(`wildgs train SCENE --output {self.folder} --resume`)"
            )
        return root


def load_run(folder: Path, device: torch.device | None = None) -> Run:
    """Loads the newest checkpoint of a run.

    Raises:
        UserError: The folder holds no run, or no checkpoint yet.
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
            f"{folder / CONFIG_FILE} was changed after training ({changes}); what follows is of the changed "
            "configuration",
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
    """Reports entries that a checkpoint lacks as a `UserError`: it is of another program, or another version."""
    try:
        yield
    except (KeyError, IndexError, TypeError, ValueError, RuntimeError) as error:
        first = (str(error).splitlines() or [""])[0]
        raise UserError(
            f"{folder}: its checkpoint is not one of this version's training ({type(error).__name__}: {first})"
        ) from error


@contextmanager
def holding(lock_file: Path) -> Iterator[bool | None]:
    """Tries to lock a file while the block runs; the lock ends with the process.

    Yields:
        Whether this process holds the lock; None on a disk without locks, as some network disks are.

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
    """Keeps other trainings out of a run folder while the block runs.

    Raises:
        UserError: Another process uses the folder, or it cannot be written to.
    """
    with holding(folder / LOCK_FILE) as held:
        if held is None:
            message = f"{folder} is on a disk without locks: nothing keeps a second training out of it"
            warnings.warn(message, WildGSWarning, stacklevel=3)
        elif not held:
            raise UserError(
                f"{folder} is in use by another training; wait for it or stop it, or choose another --output"
            )
        yield


def newest_checkpoint(folder: Path, *, set_aside: bool = False) -> Checkpoint | None:
    """The newest undamaged checkpoint of a run folder, or None; see `load_newest`."""
    return load_newest(folder / CHECKPOINT_FOLDER, set_aside=set_aside)


def refuse_trained(folder: Path) -> None:
    """Raises `UserError` if a folder holds a run already, or no checkpoints can be written to it."""
    checkpoints = folder / CHECKPOINT_FOLDER
    if checkpoints.exists() and not checkpoints.is_dir():
        raise UserError(f"{checkpoints} is not a folder: move it away, or choose another --output")
    if list_checkpoints(checkpoints):
        raise UserError(f"{folder} already holds a run; add --resume to continue, or choose another --output")


def prepare_training(
    folder: Path,
    config: RunConfig,
    scene: Scene,
    *,
    resume: bool,
    team: Team | None = None,
    progress: Counter | None = None,
) -> Trainer:
    """A trainer at step 0, or at the newest undamaged checkpoint of a run, with a budget that may be lower.

    Of several processes, rank 0 alone reads and writes the run folder.

    Args:
        folder: The run folder.
        config: Of the run.
        scene: The scene to train on.
        resume: Whether to resume a run.
        team: The processes that train the run.
        progress: Called with (photos, photos in all) while photos are copied to the run folder.

    Raises:
        UserError: As `start_training` and `resume_training` do.
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
        # Saved at once, so that a run that is killed now resumes from this state.
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
    """A trainer at step 0; writes the run's configuration and what the run carries of its scene.

    Raises:
        UserError: The folder already holds a trained run.
    """
    team = team or Team()
    team.from_first(lambda: _claim(folder, config, scene, progress))
    device = device or default_device()
    # The trainer keeps the generators' states; the process gets its own back.
    with team.propagate_errors(), torch.random.fork_rng([device] if device.type == "cuda" else []):
        torch.manual_seed(config.train.seed)
        budget = config.train.density.max_gaussians
        method = create_method(
            config.method, config.model, scene, max_gaussians=budget, seed=config.train.seed
        )
        return Trainer(method.to(device), scene, config.train, team)


def _claim(folder: Path, config: RunConfig, scene: Scene, progress: Counter | None) -> None:
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
    """A trainer at the newest undamaged checkpoint, with the configuration that the run began with.

    A run that was killed before its first checkpoint starts at step 0 again. Cameras, split, points and alignment
    are those that the run carries; a run of an earlier version carries them from now on.

    Raises:
        UserError: The folder holds no run, all checkpoints are damaged, or the run is of another scene.
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
            f"{folder / CONFIG_FILE} was changed after training began ({changes}); put it back as it was, or start "
            "a new run in another --output"
        )


def save_run(folder: Path, trainer: Trainer, config: RunConfig, alignment: Alignment) -> Path:
    """Writes a checkpoint of a run; raises `UserError` if it cannot be written."""
    return save_checkpoint(folder / CHECKPOINT_FOLDER, *run_state(trainer, config, alignment))


def run_state(
    trainer: Trainer, config: RunConfig, alignment: Alignment
) -> tuple[int, dict[str, Tensor], dict[str, Any]]:
    """What a checkpoint of a run holds: step, tensors and header."""
    header: dict[str, Any] = {"config": to_plain(config), "alignment": alignment.to_dict()}
    return trainer.step, trainer.state(), header
