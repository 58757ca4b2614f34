"""Training with all that surrounds it: memory planned, records, checkpoints, signals, the viewer beside it."""

from __future__ import annotations

import gc
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from wildgs import features
from wildgs.cli.interrupts import InterruptedTrainingError, StopOnSignal
from wildgs.cli.logs import logger, run_log
from wildgs.cli.progress import TrainingProgress, console, counting
from wildgs.config import RunConfig, read_config
from wildgs.engine.autosave import Autosave, AutosaveConfig
from wildgs.engine.checkpoint_writer import CheckpointWriter
from wildgs.engine.memory import plan_budget
from wildgs.engine.recorder import Recorder
from wildgs.engine.team import Team
from wildgs.engine.trainer import Observer, Trainer
from wildgs.errors import UserError, WildGSWarning
from wildgs.runs import CONFIG_FILE, default_device, lock_run, prepare_training, save_run
from wildgs.scene import Scene, load_scene
from wildgs.viewer.server import ServerConfig

if TYPE_CHECKING:
    from wildgs.viewer.viewer import Viewer

RETRY_SHARE = 0.8
LEAST_SECONDS_ON_CUDA = 60.0
"""Between two checkpoints; there a thousand steps take some ten seconds."""
"""Of the Gaussians with which memory ran out, for the second try."""


class Window:
    """The viewer beside a training."""

    def __init__(self, scene: Scene, server: ServerConfig, title: str) -> None:
        """Sets up a `Window`; `open` shows it."""
        self._scene, self._server, self._title = scene, server, title
        self._viewer: Viewer | None = None
        self._trainer: Trainer | None = None

    def open(self, trainer: Trainer) -> Observer:
        """Shows a training; what it returns gives the viewer its turns between two steps."""
        from wildgs.cli.view import watch_training

        self._trainer = trainer
        self._viewer, turns = watch_training(trainer, self._scene, self._server, self._title)
        return turns

    def close(self) -> None:
        """Shuts the viewer and lets go of the trainer."""
        if self._viewer is not None:
            self._viewer.close()
        self._viewer = self._trainer = None

    def stay(self) -> None:
        """Keeps showing what was trained, until Ctrl-C."""
        from wildgs.cli.view import stay

        if self._viewer is None or self._trainer is None:
            return
        console.print("the viewer stays open (Ctrl-C ends it)")
        count = len(self._trainer.method.gaussians)
        self._viewer.set_status(f"trained {self._trainer.step:,} steps, {count:,} Gaussians")
        self._viewer.ask_for_update()
        stay(self._viewer)


def read_scene(config: RunConfig) -> Scene:
    """Loads a scene and says what is in it."""
    with counting("reading photos") as progress:
        scene = load_scene(config.scene, config.data, progress=progress)
    console.print(
        f"{scene.root}: {len(scene.train_views)} photos train, {len(scene.test_views)} test, "
        f"{len(scene.points):,} points"
    )
    return scene


def with_budget(config: RunConfig, max_gaussians: int) -> RunConfig:
    """The same run with another budget of Gaussians.

    Raises:
        UserError: The budget is below 1.
    """
    if max_gaussians < 1:
        raise UserError(f"--max-gaussians {max_gaussians}: must be 1 or more")
    density = replace(config.train.density, max_gaussians=max_gaussians)
    return replace(config, train=replace(config.train, density=density))


def plan_memory(config: RunConfig, scene: Scene, *, explicit: bool = False) -> RunConfig:
    """The run with a budget of Gaussians that fits into memory, with a word where it was lowered.

    Raises:
        UserError: It cannot fit.
    """
    wish = config.train.density.max_gaussians
    budget, word = plan_budget(config.method, scene, wish, default_device(), explicit=explicit)
    if word is not None:
        console.print(word)
    return config if budget == wish else with_budget(config, budget)


def train_or_go_on(folder: Path, config: RunConfig, scene: Scene) -> None:
    """Trains a run that `config` describes, from where an earlier, interrupted call left it.

    Raises:
        UserError: The folder holds a run of another configuration.
    """
    with lock_run(folder):
        resume = (folder / CONFIG_FILE).is_file()
        if not resume:
            config = plan_memory(config, scene)
        else:
            stored = read_config(folder / CONFIG_FILE)
            if with_budget(stored, 1) != with_budget(config, 1):
                raise UserError(
                    f"{folder} holds a run with other settings; choose another --output, or go on with that one "
                    f"by `wildgs train {config.scene} --output {folder} --resume`"
                )
            config = stored
        train_within_memory(folder, config, scene, resume=resume)


def train_within_memory(
    folder: Path,
    config: RunConfig,
    scene: Scene,
    *,
    resume: bool,
    autosave: AutosaveConfig | None = None,
    window: Window | None = None,
    team: Team | None = None,
) -> None:
    """Trains to the end; where the GPU's memory runs out, once more from the newest checkpoint with less.

    Raises:
        UserError: Memory ran out twice.
    """
    lowered = _train_unless_full(folder, config, scene, resume, autosave, window, team)
    if lowered is None:
        return
    gc.collect()
    torch.cuda.empty_cache()
    budget = lowered.train.density.max_gaussians
    message = (
        f"the GPU's memory ran out; going on from the newest checkpoint with at most {budget:,} Gaussians"
    )
    warnings.warn(message, WildGSWarning, stacklevel=2)
    if _train_unless_full(folder, lowered, scene, True, autosave, window, team) is not None:
        raise UserError(
            "the GPU's memory ran out again: go on with --resume and a lower --max-gaussians, or start anew with a "
            "higher --downscale; other programs on this GPU take memory too (nvidia-smi shows them)"
        )


def _train_unless_full(
    folder: Path,
    config: RunConfig,
    scene: Scene,
    resume: bool,
    autosave: AutosaveConfig | None,
    window: Window | None = None,
    team: Team | None = None,
) -> RunConfig | None:
    """Trains to the end, or returns the configuration to try next.

    What ran out of memory is freed when this returns: nothing else holds the trainer.

    Raises:
        UserError: Memory ran out on one of several processes: the others cannot be asked to try again.
    """
    trainer: Trainer | None = None
    try:
        trainer = prepare_training(folder, config, scene, resume=resume, team=team)
        observers = [] if window is None else [window.open(trainer)]
        train_to_end(folder, config, scene, trainer, autosave, observers)
    except torch.OutOfMemoryError as error:
        if window is not None:
            window.close()
        if team is not None and team.size > 1:
            raise UserError(
                "a GPU's memory ran out: go on with --resume and a lower --max-gaussians"
            ) from error
        count = len(scene.points) if trainer is None else len(trainer.method.gaussians)
        budget = min(count, config.train.density.max_gaussians)
        return with_budget(config, max(1, int(RETRY_SHARE * budget)))
    except BaseException:
        if window is not None:
            window.close()
        raise
    return None


def train_to_end(
    folder: Path,
    config: RunConfig,
    scene: Scene,
    trainer: Trainer,
    autosave: AutosaveConfig | None = None,
    observers: Sequence[Observer] = (),
) -> None:
    """Trains what is left, recording and saving.

    Only whole steps are saved: whatever else breaks off a step leaves the newest checkpoint as it was.

    Raises:
        InterruptedTrainingError: A signal came; the last step is saved.
    """
    team = trainer.team
    if not team.first:
        _follow(trainer)
        return
    label = f"training {config.method}" + (f" on {team.size} processes" if team.size > 1 else "")
    on_cuda = trainer.device.type == "cuda"
    writer = CheckpointWriter(background=on_cuda and features.is_on("checkpoint_thread"))
    saver = Autosave(
        lambda: save_run(folder, trainer, config, scene.alignment, writer),
        autosave or AutosaveConfig(),
        trainer.step,
        least_seconds=LEAST_SECONDS_ON_CUDA if on_cuda else 0.0,
    )
    with (
        run_log(folder),
        Recorder(folder, step=trainer.step) as recorder,
        TrainingProgress(label, config.train.steps, trainer.step) as progress,
        StopOnSignal(team) as stop,
    ):
        logger.info("%s from step %d of %d", label, trainer.step, config.train.steps)
        try:
            trainer.run([recorder, progress, saver, stop, *observers])
        except InterruptedTrainingError as interrupt:
            team.from_first(lambda: _save_last(saver, writer, trainer.step))
            interrupt.args = (f"{interrupt}, saved in {folder}; the same command with --resume goes on",)
            raise
        _save_last(saver, writer, trainer.step)
        logger.info("done: %d steps in %.0f s", trainer.step, trainer.seconds)
    minutes = trainer.seconds / 60
    console.print(
        f"{label}: {trainer.step} steps in {minutes:.1f} min on {_device_name(trainer.device)}, "
        f"{len(trainer.method.gaussians):,} Gaussians -> {folder}"
    )


def _save_last(saver: Autosave, writer: CheckpointWriter, step: int) -> None:
    """Saves the last step and waits until it is on the disk."""
    saver.save(step)
    writer.wait()


def _follow(trainer: Trainer) -> None:
    """Trains as one of rank 0's company, which writes and tells everything."""
    with StopOnSignal(trainer.team) as stop:
        try:
            trainer.run([stop])
        except InterruptedTrainingError:
            trainer.team.from_first(lambda: None)  # waits until rank 0 has saved
            raise


def _device_name(device: torch.device) -> str:
    return torch.cuda.get_device_name(device) if device.type == "cuda" else "the CPU"
