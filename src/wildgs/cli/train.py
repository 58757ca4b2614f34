"""`wildgs train`: a scene with poses becomes a trained run."""

from __future__ import annotations

import argparse
from contextlib import ExitStack
from dataclasses import dataclass, field, make_dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from wildgs.cli.progress import console
from wildgs.cli.training import Window, plan_memory, read_scene, train_within_memory, with_budget
from wildgs.config import RunConfig, read_config
from wildgs.engine.autosave import AutosaveConfig
from wildgs.engine.distributed import join
from wildgs.engine.team import Team
from wildgs.engine.trainer import TrainConfig
from wildgs.model.registry import DEFAULT_METHOD, METHODS, MethodName, config_type
from wildgs.presets import PRESET_NAMES, PresetName, with_preset
from wildgs.runs import (
    CONFIG_FILE,
    lock_run,
    refuse_trained,
)
from wildgs.scene import DataConfig
from wildgs.viewer.server import ServerConfig, import_viser


@dataclass(frozen=True)
class Command:
    """Trains Wild-GS (or its baseline 3dgs) on a COLMAP scene.

    Example: wildgs train brandenburg_gate --output runs/gate --downscale 2
    """

    scene: tyro.conf.Positional[Path]
    """Scene folder: images/ and sparse/0/ (see docs/scene.md)."""
    output: Path
    """Run folder to write."""
    method: MethodName = DEFAULT_METHOD
    """Method to train; `--method NAME --help` lists its options. 3dgs is plain 3D Gaussian Splatting."""
    preset: PresetName = "default"
    """default: the best measured; paper: nothing that the paper does not have; fast: half the steps and a lighter
    2D Parsing. Other options change what the preset sets."""
    resume: bool = False
    """Go on from the run's newest checkpoint, with the configuration it began with."""
    max_gaussians: int | None = None
    """Most Gaussians; by default what `--density.max-gaussians` says, or less where memory is short."""
    data: Annotated[DataConfig, tyro.conf.arg(name="")] = field(default_factory=DataConfig)
    model: Any = None  # `command_for` gives it the type of the method's options
    train: Annotated[TrainConfig, tyro.conf.arg(name="")] = field(default_factory=TrainConfig)
    autosave: Annotated[AutosaveConfig, tyro.conf.arg(name="")] = field(default_factory=AutosaveConfig)
    view: bool = False
    """Show training in the browser, and stay there when it is done. Takes at most 5% of the time."""
    server: ServerConfig = field(default_factory=ServerConfig)


def command_for(arguments: list[str]) -> type[Command]:
    """The command with the options of the method among the arguments, and the preset's values as defaults."""
    finder = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    finder.add_argument("--preset", choices=PRESET_NAMES, default="default")
    finder.add_argument("--method", choices=tuple(METHODS), default=DEFAULT_METHOD)
    try:
        found = finder.parse_known_args(arguments)[0]
    except argparse.ArgumentError:
        found = finder.parse_args([])  # tyro reports what is wrong
    config = with_preset(RunConfig(Path(), found.method), found.preset)
    unnamed = tyro.conf.arg(name="")
    method = Literal[tuple(METHODS)]  # pyright: ignore[reportInvalidTypeForm]
    fields = [
        ("data", Annotated[DataConfig, unnamed], field(default=config.data)),
        ("method", method, field(default=found.method)),
        ("model", Annotated[config_type(found.method), unnamed], field(default=config.model)),
        ("train", Annotated[TrainConfig, unnamed], field(default=config.train)),
    ]
    return make_dataclass("Command", fields, bases=(Command,), frozen=True)


def run(command: Command) -> None:
    """Trains, with progress on the console; one of several processes where torchrun started it."""
    with join() as team:
        console.quiet = not team.first
        _run(command, team)


def _run(command: Command, team: Team) -> None:
    config = RunConfig(command.scene.resolve(), command.method, command.data, command.model, command.train)
    if command.resume:
        stored = team.from_first(lambda: read_config(command.output / CONFIG_FILE))
        config = replace(stored, scene=config.scene)
        if command.data.image_cache != DataConfig().image_cache:  # it has no influence on the result
            config = replace(config, data=replace(config.data, image_cache=command.data.image_cache))
    if command.max_gaussians is not None:
        config = with_budget(config, command.max_gaussians)
    if command.view:
        import_viser()  # a mistake is told before photos are read
    window: Window | None = None
    with ExitStack() as stack:
        team.from_first(lambda: stack.enter_context(lock_run(command.output)))
        with team.together():
            scene = read_scene(config)
        if not command.resume:
            team.from_first(lambda: refuse_trained(command.output))
            with team.together():
                config = plan_memory(config, scene, explicit=command.max_gaussians is not None)
            config = with_budget(config, team.least(config.train.density.max_gaussians))
        if command.view and team.first:
            window = Window(scene, command.server, command.output.resolve().name)
        train_within_memory(
            command.output,
            config,
            scene,
            resume=command.resume,
            autosave=command.autosave,
            window=window,
            team=team,
        )
    if window is not None:
        window.stay()
