"""Run folders: what training leaves and every other verb reads."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from wildgs.config import RunConfig, read_config, to_plain, write_config
from wildgs.data import Alignment, Scene, load_scene
from wildgs.engine.checkpoint import Checkpoint, list_checkpoints, load_checkpoint, save_checkpoint
from wildgs.engine.trainer import Trainer
from wildgs.errors import UserError
from wildgs.model.method import Method
from wildgs.model.registry import create_method, restore_method

CONFIG_FILE = "config.yaml"
CHECKPOINT_FOLDER = "checkpoints"


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

    def load_scene(self, progress: Callable[[int, int], None] | None = None, *, lazy: bool = False) -> Scene:
        """The scene on which the run was trained; `lazy` decodes photos only when they are asked for."""
        return load_scene(self.config.scene, self.config.data, lazy=lazy, progress=progress)


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
    method = restore_method(config.method, config.model, checkpoint.method)
    return Run(
        folder=folder,
        config=config,
        method=method.to(device or default_device()).eval(),
        step=int(checkpoint.state["progress.step"]),
        train_seconds=float(checkpoint.state["progress.seconds"]),
        alignment=Alignment.from_dict(checkpoint.header["alignment"]),
    )


def newest_checkpoint(folder: Path) -> Checkpoint | None:
    """The newest checkpoint of a run folder, or None."""
    checkpoints = list_checkpoints(folder / CHECKPOINT_FOLDER)
    return load_checkpoint(checkpoints[-1]) if checkpoints else None


def start_training(
    folder: Path, config: RunConfig, scene: Scene, device: torch.device | None = None
) -> Trainer:
    """A trainer at step 0; writes the run's configuration.

    Raises:
        UserError: The folder already holds a trained run.
    """
    if list_checkpoints(folder / CHECKPOINT_FOLDER):
        raise UserError(f"{folder} already holds a run; add --resume to go on, or choose another --output")
    folder.mkdir(parents=True, exist_ok=True)
    write_config(folder / CONFIG_FILE, config)
    torch.manual_seed(config.train.seed)
    method = create_method(config.method, config.model, scene.points, scene.point_colors)
    return Trainer(method.to(device or default_device()), scene, config.train)


def resume_training(folder: Path, scene: Scene, device: torch.device | None = None) -> Trainer:
    """A trainer at the newest checkpoint, with the configuration that the run began with.

    Raises:
        UserError: The folder holds no run, or no checkpoint yet.
    """
    config = read_config(folder / CONFIG_FILE)
    checkpoint = newest_checkpoint(folder)
    if checkpoint is None:
        raise UserError(f"{folder} has no checkpoint to resume from; leave --resume out")
    method = restore_method(config.method, config.model, checkpoint.method)
    trainer = Trainer(method.to(device or default_device()), scene, config.train)
    trainer.restore(checkpoint.state)
    return trainer


def save_run(folder: Path, trainer: Trainer, config: RunConfig, alignment: Alignment) -> Path:
    """Writes a checkpoint from which training can go on and every other verb can read."""
    header: dict[str, Any] = {"config": to_plain(config), "alignment": alignment.to_dict()}
    return save_checkpoint(folder / CHECKPOINT_FOLDER, trainer.step, trainer.state(), header)
