"""`wildgs.train`: plans memory, trains, logs, saves checkpoints and handles signals."""

from __future__ import annotations

import gc
import tempfile
import warnings
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import torch

from wildgs import features
from wildgs.config import BUDGET, ExecutionConfig, RunConfig, differing_entries, validated
from wildgs.config_file import CONFIG_FILE, read_config
from wildgs.engine.autosave import Autosave, CheckpointWriter
from wildgs.engine.memory import plan_budget
from wildgs.engine.recorder import Recorder
from wildgs.engine.report import Observer, StepReport
from wildgs.engine.team import Team
from wildgs.engine.trainer import Trainer
from wildgs.errors import UserError, WildGSWarning
from wildgs.evaluation.photos import PhotoFit, describe_misfits, inspect_photos, write_photos
from wildgs.files import is_file
from wildgs.library.logs import InterruptedTrainingError, StopOnSignal, logger, run_log
from wildgs.light.photos import KeptAppearances
from wildgs.progress import Progress, counter, silent
from wildgs.runs import (
    CHECKPOINT_FOLDER,
    default_device,
    lock_run,
    prepare_training,
    refuse_trained,
    run_state,
    save_run,
)
from wildgs.scene import Scene, load_scene
from wildgs.scene.carried import describe_carried
from wildgs.scene.config import parse_bytes
from wildgs.threads import limited

LEAST_SECONDS_ON_CUDA = 60.0
"""Smallest time between checkpoints on a GPU, where a thousand steps take about ten seconds."""
RETRY_SHARE = 0.8
"""Upper bound on Gaussians of the second attempt, relative to their number when memory ran out."""

Attachment = Callable[[Trainer, Scene], AbstractContextManager[Observer]]
"""Opens an observer of one training, such as a viewer, which is closed when the training ends or fails."""


@dataclass(frozen=True)
class TrainedRun:
    """A finished training.

    Attributes:
        folder: The run folder.
        config: Its configuration.
        steps: Number of steps done.
        seconds: Training time, without reading photos and saving.
        num_gaussians: Final number of Gaussians.
        device: Name of the GPU, or "the CPU".
        photos: How well each training photo fits; `find_misfits` selects misfits.
        appearances: Appearances of the training photos under the trained method.
    """

    folder: Path
    config: RunConfig
    steps: int
    seconds: float
    num_gaussians: int
    device: str
    photos: Sequence[PhotoFit] = ()
    appearances: KeptAppearances = field(default_factory=KeptAppearances, repr=False, compare=False)


@dataclass(frozen=True)
class _Job:
    """Arguments that stay the same when training is retried with fewer Gaussians."""

    folder: Path
    scene: Scene
    execution: ExecutionConfig
    team: Team
    progress: Progress
    observers: Sequence[Observer]
    attach: Sequence[Attachment]
    again: str
    """How the same command continues after an interruption: `again`, or `with --resume`."""


def train(
    scene: str | Path | Scene,
    config: RunConfig | None = None,
    *,
    output: str | Path,
    execution: ExecutionConfig | None = None,
    resume: bool | Literal["auto"] = False,
    max_gaussians: int | None = None,
    progress: Progress | None = None,
    observers: Sequence[Observer] = (),
    attach: Sequence[Attachment] = (),
    team: Team | None = None,
    locked: bool = False,
) -> TrainedRun:
    """Trains a run.

    The first SIGINT, SIGTERM or SIGHUP saves and stops after the current step. If a GPU runs out of memory,
    training continues once from the newest checkpoint with fewer Gaussians.

    Args:
        scene: A scene folder, or a scene read from one.
        config: Options that affect the result; None takes the defaults, or the run's when resuming.
        output: The run folder.
        execution: Options that do not affect the result.
        resume: Continue from the newest checkpoint; "auto" does so if the folder contains a run.
        max_gaussians: Upper bound on the number of Gaussians; too little memory for it is an error.
        progress: Called for every photo read and for every step.
        observers: Called with a `StepReport` after every step.
        attach: Openers of further observers, which are closed when training ends.
        team: The processes that train together. Default: this process alone.
        locked: Whether the caller holds the run folder's lock.

    Raises:
        UserError: The scene cannot be used, the folder contains another run, memory or disk space is too small, or
            training diverged.
        InterruptedTrainingError: A signal arrived; the last step is saved.
    """
    folder, execution, team = Path(output), validated(execution or ExecutionConfig()), team or Team()
    config = None if config is None else validated(config)
    progress = progress or silent
    if not is_file(folder / CONFIG_FILE):
        _refuse_input(folder, scene.root if isinstance(scene, Scene) else Path(scene))
    with limited(execution.threads), ExitStack() as stack:
        if not locked:
            team.from_first(lambda: stack.enter_context(lock_run(folder)))
        again = "again" if resume == "auto" else "with --resume"
        if resume == "auto":
            resume = team.from_first(lambda: (folder / CONFIG_FILE).is_file())
        if resume:
            stored = team.from_first(lambda: read_config(folder / CONFIG_FILE))
            config = _resumed(folder, stored, config)
        else:
            team.from_first(lambda: refuse_trained(folder))
            config = config or RunConfig()
        if max_gaussians is not None:
            config = with_budget(config, max_gaussians)
        if not isinstance(scene, Scene):
            config = replace(config, scene=Path(scene).resolve())
        with team.propagate_errors():
            read = scene if isinstance(scene, Scene) else read_scene(config, execution, progress)
        if not resume:
            with team.propagate_errors():
                config = plan_memory(config, read, explicit=max_gaussians is not None)
            config = with_budget(config, team.least(config.train.density.max_gaussians))
        job = _Job(folder, read, execution, team, progress, observers, attach, again)
        return _train_within_memory(job, config, resume=bool(resume))


def _refuse_input(folder: Path, scene: Path) -> None:
    """Raises `UserError` if the run would be written among the files of its scene."""
    place = folder.resolve()
    inputs = [(scene / part).resolve() for part in ("images", "sparse", "masks", "depth")]
    if place == scene.resolve() or any(place.is_relative_to(part) for part in inputs):
        raise UserError(f"{folder}: contains the scene's own files; choose another --output for the run")


def _resumed(folder: Path, stored: RunConfig, requested: RunConfig | None) -> RunConfig:
    """The configuration of a resumed run; raises `UserError` if it differs from the stored one."""
    if requested is None:
        return stored
    differing = differing_entries(stored, requested)
    differing.pop(BUDGET, None)
    if differing:
        changes = ", ".join(f"{path} is {old}, not {new}" for path, (old, new) in list(differing.items())[:3])
        raise UserError(
            f"{folder} holds a run with other settings ({changes}), which resuming cannot change; leave these "
            "options out, or choose another --output for a new run"
        )
    return requested


def read_scene(config: RunConfig, execution: ExecutionConfig, progress: Progress | None = None) -> Scene:
    """Reads the scene of a configuration and logs its size."""
    show = counter(progress, "reading photos")
    scene = load_scene(config.scene, config.data, image_cache=execution.image_cache, progress=show)
    train, test = len(scene.train_views), len(scene.test_views)
    logger.info(
        f"{scene.root}: {train} training photos, {test} held-out photos, {len(scene.points):,} points"
    )
    return scene


def with_budget(config: RunConfig, max_gaussians: int) -> RunConfig:
    """The configuration with another upper bound on the number of Gaussians, which must be 1 or more."""
    if max_gaussians < 1:
        raise UserError(f"--max-gaussians {max_gaussians}: must be 1 or more")
    density = replace(config.train.density, max_gaussians=max_gaussians)
    return replace(config, train=replace(config.train, density=density))


def plan_memory(config: RunConfig, scene: Scene, *, explicit: bool = False) -> RunConfig:
    """Lowers the upper bound on the number of Gaussians, with a warning, if memory is too small."""
    requested = config.train.density.max_gaussians
    budget, message = plan_budget(config.method, scene, requested, default_device(), explicit=explicit)
    if message is not None:
        warnings.warn(message, WildGSWarning, stacklevel=2)
    return config if budget == requested else with_budget(config, budget)


def _train_within_memory(job: _Job, config: RunConfig, *, resume: bool) -> TrainedRun:
    """Trains to the end; retries once from the newest checkpoint if the GPU runs out of memory."""
    result = _train_unless_full(job, config, resume)
    if isinstance(result, TrainedRun):
        return result
    gc.collect()
    torch.cuda.empty_cache()
    budget = result.train.density.max_gaussians
    message = (
        f"the GPU ran out of memory; continuing from the newest checkpoint with at most {budget:,} Gaussians"
    )
    warnings.warn(message, WildGSWarning, stacklevel=3)
    again = _train_unless_full(job, result, True)
    if isinstance(again, TrainedRun):
        return again
    raise UserError(
        "the GPU ran out of memory again: continue with --resume and a lower --max-gaussians, or train again with "
        "a higher --downscale; other programs on this GPU use memory too (nvidia-smi lists them)"
    )


def _train_unless_full(job: _Job, config: RunConfig, resume: bool) -> TrainedRun | RunConfig:
    """Trains to the end, or frees the trainer and returns a smaller configuration if GPU memory runs out.

    With several processes, running out of memory is an error, because the others cannot be restarted.
    """
    trainer: Trainer | None = None
    try:
        trainer = prepare_training(
            job.folder,
            config,
            job.scene,
            resume=resume,
            team=job.team,
            progress=counter(job.progress, "copying photos to the run"),
        )
        if job.team.first and not resume:
            logger.info(describe_carried(job.folder))
        trainer.cuda_graphs = job.execution.cuda_graphs
        trainer.feature_cache = parse_bytes(job.execution.feature_cache)
        trainer.on_compared_photo = counter(job.progress, "comparing training photos")
        trainer.foregrounds.on_photo = counter(job.progress, "comparing depth maps")
        trainer.on_final_photo = counter(job.progress, "fitting the light of training photos")
        with ExitStack() as stack:
            if job.team.first:
                observers = [stack.enter_context(open_one(trainer, job.scene)) for open_one in job.attach]
                return _train_to_end(job, config, trainer, [*job.observers, *observers])
            return _follow(job, config, trainer)
    except torch.OutOfMemoryError as error:
        if job.team.size > 1:
            raise UserError(
                "a GPU ran out of memory: continue with --resume and a lower --max-gaussians"
            ) from error
        count = len(job.scene.points) if trainer is None else len(trainer.method.gaussians)
        budget = min(count, config.train.density.max_gaussians)
        return with_budget(config, max(1, int(RETRY_SHARE * budget)))


def _train_to_end(
    job: _Job, config: RunConfig, trainer: Trainer, observers: Sequence[Observer]
) -> TrainedRun:
    """Trains the remaining steps with logs and checkpoints, on rank 0."""
    team, folder, execution = job.team, job.folder, job.execution
    label = f"training {config.method}" + (f" on {team.size} processes" if team.size > 1 else "")
    alignment = job.scene.alignment

    def rescue() -> Path:
        place = Path(tempfile.mkdtemp(prefix=f"wildgs-{folder.resolve().name}-"))
        return save_run(place, trainer, config, alignment)

    def show(report: StepReport) -> None:
        job.progress(label, report.step, config.train.steps)

    on_cuda = trainer.device.type == "cuda"
    writer = CheckpointWriter(background=on_cuda and features.is_on("checkpoint_thread"))
    saver = Autosave(
        lambda: writer.save(folder / CHECKPOINT_FOLDER, *run_state(trainer, config, alignment)),
        every=execution.checkpoint_every,
        minutes=execution.checkpoint_minutes,
        step=trainer.step,
        rescue=rescue,
        least_seconds=LEAST_SECONDS_ON_CUDA if on_cuda else 0.0,
    )
    with (
        run_log(folder),
        Recorder(
            folder,
            scalars_every=execution.log_every,
            pictures_every=execution.pictures_every,
            step=trainer.step,
        ) as recorder,
        StopOnSignal(team) as stop,
    ):
        logger.debug("%s from step %d of %d", label, trainer.step, config.train.steps)
        job.progress(label, trainer.step, config.train.steps)
        try:
            trainer.run([recorder, *observers, show, saver, stop])
        except InterruptedTrainingError as interrupt:
            team.from_first(lambda: _save_last(saver, writer, trainer.step, hurry=True))
            interrupt.args = (
                f"{interrupt}, saved in {folder}; run the same command {job.again} to continue",
            )
            raise
        _save_last(saver, writer, trainer.step)
        result = _result(job, config, trainer)
        result = replace(result, photos=_inspect(job, trainer, result.appearances))
        logger.info(
            f"{label}: {result.steps} steps in {result.seconds / 60:.1f} min on {result.device}, "
            f"{result.num_gaussians:,} Gaussians -> {folder}"
        )
        for line in describe_misfits(result.photos):
            logger.info("%s", line)
    return result


def _inspect(job: _Job, trainer: Trainer, appearances: KeptAppearances) -> list[PhotoFit]:
    """Measures how well each training photo fits, writes the result to the run folder and keeps appearances."""
    show = counter(job.progress, "inspecting training photos")
    photos = inspect_photos(trainer.method, job.scene, show, appearances.keep)
    write_photos(job.folder, trainer.step, photos)
    return photos


def _save_last(saver: Autosave, writer: CheckpointWriter, step: int, *, hurry: bool = False) -> None:
    """Saves the last step and waits until it is on the disk; see `Autosave.save_last`."""
    if not writer.finish():
        saver.saved_step = 0  # writing failed: the last step must be written again
    saver.save_last(step, hurry=hurry)


def _follow(job: _Job, config: RunConfig, trainer: Trainer) -> TrainedRun:
    """Trains on a rank other than 0: no output and no files."""
    with StopOnSignal(trainer.team) as stop:
        try:
            trainer.run([stop])
        except InterruptedTrainingError:
            trainer.team.from_first(lambda: None)  # waits until rank 0 has saved
            raise
    return _result(job, config, trainer)


def _result(job: _Job, config: RunConfig, trainer: Trainer) -> TrainedRun:
    device = trainer.device
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else "the CPU"
    count = len(trainer.method.gaussians)
    return TrainedRun(job.folder, config, trainer.step, trainer.seconds, count, name)
