"""`wildgs train`: a scene with poses becomes a trained run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import torch
import tyro

from wildgs.cli.progress import TrainingProgress, console, counting
from wildgs.config import RunConfig, read_config
from wildgs.data import DataConfig, Scene, load_scene
from wildgs.engine.recorder import Recorder
from wildgs.engine.trainer import Observer, TrainConfig, Trainer
from wildgs.model.registry import MethodName
from wildgs.model.wildgs import WildGSConfig
from wildgs.runs import CONFIG_FILE, resume_training, save_run, start_training
from wildgs.viewer.server import ServerConfig, import_viser

CHECKPOINT_EVERY = 1000


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
    view: bool = False
    """Show training in the browser, and stay there when it is done. Takes at most 5% of the time."""
    server: ServerConfig = field(default_factory=ServerConfig)


def run(command: Command) -> None:
    """Trains, with progress on the console."""
    config = RunConfig(command.scene.resolve(), command.method, command.data, command.model, command.train)
    if command.resume:
        config = replace(read_config(command.output / CONFIG_FILE), scene=config.scene)
    if command.view:
        import_viser()  # a mistake is told before photos are read
    scene = read_scene(config)
    if command.resume:
        trainer = resume_training(command.output, scene)
    else:
        trainer = start_training(command.output, config, scene)
    if command.view:
        _train_in_view(command, config, scene, trainer)
    else:
        train_to_end(command.output, config, scene, trainer)


def _train_in_view(command: Command, config: RunConfig, scene: Scene, trainer: Trainer) -> None:
    from wildgs.cli.view import stay, watch_training

    viewer, turns = watch_training(trainer, scene, command.server, command.output.resolve().name)
    try:
        train_to_end(command.output, config, scene, trainer, [turns])
    except BaseException:
        viewer.close()
        raise
    console.print("the viewer stays open (Ctrl-C ends it)")
    viewer.set_status(f"trained {trainer.step:,} steps, {len(trainer.method.gaussians):,} Gaussians")
    viewer.ask_for_update()
    stay(viewer)


def read_scene(config: RunConfig) -> Scene:
    """Loads a scene and says what is in it."""
    with counting("reading photos") as progress:
        scene = load_scene(config.scene, config.data, progress=progress)
    console.print(
        f"{scene.root}: {len(scene.train_views)} photos train, {len(scene.test_views)} test, "
        f"{len(scene.points):,} points"
    )
    return scene


def train_to_end(
    folder: Path, config: RunConfig, scene: Scene, trainer: Trainer, observers: Sequence[Observer] = ()
) -> None:
    """Trains what is left, recording and saving; an interrupt saves first."""
    label = f"training {config.method}"
    saved = trainer.step

    def save() -> None:
        nonlocal saved
        if trainer.step > saved:
            save_run(folder, trainer, config, scene.alignment)
            saved = trainer.step

    with (
        Recorder(folder) as recorder,
        TrainingProgress(label, config.train.steps, trainer.step) as progress,
    ):
        try:
            trainer.run(
                [
                    recorder,
                    progress,
                    lambda report: save() if report.step % CHECKPOINT_EVERY == 0 else None,
                    *observers,
                ]
            )
        finally:
            save()
    minutes = trainer.seconds / 60
    console.print(
        f"{label}: {trainer.step} steps in {minutes:.1f} min on {_device_name(trainer.device)}, "
        f"{len(trainer.method.gaussians):,} Gaussians -> {folder}"
    )


def _device_name(device: torch.device) -> str:
    return torch.cuda.get_device_name(device) if device.type == "cuda" else "the CPU"
