"""`wildgs train`: a scene with poses becomes a trained run."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import torch
import tyro

from wildgs.cli.interrupts import InterruptedTrainingError, StopOnSignal
from wildgs.cli.progress import TrainingProgress, console, counting
from wildgs.config import RunConfig, read_config
from wildgs.data import DataConfig, Scene, load_scene
from wildgs.engine.autosave import Autosave, AutosaveConfig
from wildgs.engine.recorder import Recorder
from wildgs.engine.trainer import TrainConfig, Trainer
from wildgs.errors import UserError
from wildgs.model.registry import MethodName
from wildgs.model.wildgs import WildGSConfig
from wildgs.runs import CONFIG_FILE, lock_run, resume_training, save_run, start_training


@dataclass(frozen=True)
class Command:
    """Trains Wild-GS (or its baseline 3dgs) on a COLMAP scene.

    Example: wildgs train brandenburg_gate --output runs/gate --downscale 2
    """

    scene: tyro.conf.Positional[Path]
    """Scene folder: images/ and sparse/0/ (see docs/scene.md)."""
    output: Path
    """Run folder to write."""
    method: MethodName = "wildgs"
    """wildgs, or 3dgs for plain 3D Gaussian Splatting on the same engine."""
    resume: bool = False
    """Go on from the run's newest checkpoint, with the configuration it began with."""
    data: Annotated[DataConfig, tyro.conf.arg(name="")] = field(default_factory=DataConfig)
    model: Annotated[WildGSConfig, tyro.conf.arg(name="")] = field(default_factory=WildGSConfig)
    train: Annotated[TrainConfig, tyro.conf.arg(name="")] = field(default_factory=TrainConfig)
    autosave: Annotated[AutosaveConfig, tyro.conf.arg(name="")] = field(default_factory=AutosaveConfig)


def run(command: Command) -> None:
    """Trains, with progress on the console."""
    config = RunConfig(command.scene.resolve(), command.method, command.data, command.model, command.train)
    if command.resume:
        config = replace(read_config(command.output / CONFIG_FILE), scene=config.scene)
    with lock_run(command.output):
        scene = read_scene(config)
        if command.resume:
            trainer = resume_training(command.output, scene)
        else:
            trainer = start_training(command.output, config, scene)
        train_to_end(command.output, config, scene, trainer, command.autosave)


def read_scene(config: RunConfig) -> Scene:
    """Loads a scene and says what is in it."""
    with counting("reading photos") as progress:
        scene = load_scene(config.scene, config.data, progress=progress)
    console.print(
        f"{scene.root}: {len(scene.train_views)} photos train, {len(scene.test_views)} test, "
        f"{len(scene.points):,} points"
    )
    return scene


def train_or_go_on(folder: Path, config: RunConfig, scene: Scene) -> None:
    """Trains a run that `config` describes, from where an earlier, interrupted call left it.

    Raises:
        UserError: The folder holds a run of another configuration.
    """
    with lock_run(folder):
        resumes = (folder / CONFIG_FILE).is_file()
        if resumes and read_config(folder / CONFIG_FILE) != config:
            raise UserError(
                f"{folder} holds a run with other settings; choose another --output, or go on with that one by "
                f"`wildgs train {config.scene} --output {folder} --resume`"
            )
        trainer = resume_training(folder, scene) if resumes else start_training(folder, config, scene)
        train_to_end(folder, config, scene, trainer)


def train_to_end(
    folder: Path,
    config: RunConfig,
    scene: Scene,
    trainer: Trainer,
    autosave: AutosaveConfig | None = None,
) -> None:
    """Trains what is left, recording and saving.

    Only whole steps are saved: whatever else breaks off a step leaves the newest checkpoint as it was.

    Raises:
        InterruptedTrainingError: A signal came; the last step is saved.
    """
    label = f"training {config.method}"
    saver = Autosave(
        lambda: save_run(folder, trainer, config, scene.alignment), autosave or AutosaveConfig(), trainer.step
    )
    with (
        Recorder(folder, step=trainer.step) as recorder,
        TrainingProgress(label, config.train.steps, trainer.step) as progress,
        StopOnSignal() as stop,
    ):
        try:
            trainer.run([recorder, progress, saver, stop])
        except InterruptedTrainingError as interrupt:
            saver.save(trainer.step)
            interrupt.args = (f"{interrupt}, saved in {folder}; the same command with --resume goes on",)
            raise
        saver.save(trainer.step)
    minutes = trainer.seconds / 60
    console.print(
        f"{label}: {trainer.step} steps in {minutes:.1f} min on {_device_name(trainer.device)}, "
        f"{len(trainer.method.gaussians):,} Gaussians -> {folder}"
    )


def _device_name(device: torch.device) -> str:
    return torch.cuda.get_device_name(device) if device.type == "cuda" else "the CPU"
