"""`wildgs train`: trains on a scene with camera poses."""

from __future__ import annotations

import argparse
import contextlib
from contextlib import ExitStack
from dataclasses import dataclass, field, make_dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from wildgs.cli.options import UNNAMED, option_name
from wildgs.cli.screen import console, progress_shown
from wildgs.config import BUDGET, ExecutionConfig, RunConfig, differing_entries
from wildgs.config_file import CONFIG_FILE, read_config
from wildgs.engine.config import TrainConfig
from wildgs.errors import UserError
from wildgs.model.registry import DEFAULT_METHOD, METHODS, MethodName, config_type
from wildgs.presets import PRESET_NAMES, PresetName, with_preset
from wildgs.scene.config import DataConfig
from wildgs.viewer.config import ServerConfig

if TYPE_CHECKING:
    from wildgs.viewer.serving import TrainingWindow

SHOWN = (
    "method",
    "preset",
    "resume",
    "max_gaussians",
    "data.downscale",
    "data.max_side",
    "train.steps",
    "train.seed",
    "model.without",
    "execution.image_cache",
    "view",
)
"""Options in the short help."""


@dataclass(frozen=True, kw_only=True)
class Command:
    """Trains Wild-GS (or a baseline) on a COLMAP scene.

    Example: wildgs train brandenburg_gate --output runs/gate --downscale 2
    """

    scene: tyro.conf.Positional[Path]
    """Scene folder with images/ and sparse/0/ (see docs/scene.md); with --resume, its current location."""
    output: Path
    """Run folder to write."""
    method: MethodName = DEFAULT_METHOD
    """Method to train: wildgs, 3dgs (plain 3D Gaussian Splatting) or affine (per-photo embeddings and affine
    colours). `--method NAME --help-all` lists a method's options."""
    preset: PresetName = "default"
    """default: best measured results; paper: the paper's method without additions; paper-mended: the same with
    stable training of mask and fusion; fast: half the steps. Other options override the preset."""
    resume: bool = False
    """Resume from the newest checkpoint with the run's configuration. Only --max-gaussians and options that do not
    affect the result may change."""
    max_gaussians: int | None = None
    """Upper bound on the number of Gaussians. Default: --density.max-gaussians, or less if memory is short."""
    data: Annotated[DataConfig, UNNAMED] = field(default_factory=DataConfig)
    model: Annotated[Any, UNNAMED] = None  # `command_for` sets the type to the method's config
    train: Annotated[TrainConfig, UNNAMED] = field(default_factory=TrainConfig)
    execution: Annotated[ExecutionConfig, UNNAMED] = field(default_factory=ExecutionConfig)
    view: bool = False
    """Show training in the browser and keep the viewer open afterwards. Takes at most 5% of the training time."""
    server: ServerConfig = field(default_factory=ServerConfig)


def command_for(arguments: list[str]) -> type[Command]:
    """Builds the command for the method that the arguments select.

    Defaults of its options come from the configuration of the run to resume, else from the preset.
    """
    finder = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    finder.add_argument("--preset", choices=PRESET_NAMES, default="default")
    finder.add_argument("--method", choices=tuple(METHODS), default=DEFAULT_METHOD)
    finder.add_argument("--output", type=Path)
    finder.add_argument("--resume", action="store_true")
    try:
        found = finder.parse_known_args(arguments)[0]
    except argparse.ArgumentError:
        found = finder.parse_args([])  # tyro reports the error
    config, fields = RunConfig(method=found.method), []
    method = Literal[tuple(METHODS)]  # pyright: ignore[reportInvalidTypeForm]
    if found.resume and found.output is not None:
        with contextlib.suppress(UserError):  # reported when the run is opened
            config = read_config(found.output / CONFIG_FILE)
            fields.append(("scene", tyro.conf.Positional[Path], field(default=config.scene)))
        # The preset has already been applied to the stored number of steps.
        steps = config.train.steps
        config = with_preset(config, found.preset)
        config = replace(config, train=replace(config.train, steps=steps))
    else:
        config = with_preset(config, found.preset)
    parts: list[tuple[str, Any]] = [
        ("data", DataConfig),
        ("model", config_type(config.method)),
        ("train", TrainConfig),
    ]
    fields.append(("method", method, field(default=config.method)))
    fields += [(name, Annotated[kind, UNNAMED], field(default=getattr(config, name))) for name, kind in parts]
    made = make_dataclass("Command", fields, bases=(Command,), frozen=True, kw_only=True)
    made.__doc__ = Command.__doc__
    return made


def run(command: Command) -> None:
    """Trains with progress on the console, alone or as one of torchrun's processes."""
    import wildgs
    from wildgs.engine.distributed import join

    if command.resume:
        stored = read_config(command.output / CONFIG_FILE)
        if stored.method != command.method:
            raise UserError(f"{command.output} is a run of {stored.method}; leave --method out to resume it")
    config = RunConfig(command.scene.resolve(), command.method, command.data, command.model, command.train)
    if command.resume:
        _refuse_changes(command, config)
    with join() as team, ExitStack() as stack:
        console.quiet = not team.first
        window = _window(command) if command.view and team.first else None
        screen = stack.enter_context(progress_shown())
        wildgs.train(
            command.scene,
            config,
            output=command.output,
            execution=command.execution,
            resume=command.resume,
            max_gaussians=command.max_gaussians,
            progress=screen,
            observers=[screen.step],
            attach=[] if window is None else [window.attach],
            team=team,
        )
        screen.close()
        if window is not None:
            console.print("the viewer stays open (Ctrl-C ends it)")
            window.stay()


def _refuse_changes(command: Command, config: RunConfig) -> None:
    """Checks that no option of a resumed run changes its result.

    Raises:
        UserError: An option differs from the run's configuration, or there is no run.
    """
    differing = differing_entries(read_config(command.output / CONFIG_FILE), config)
    differing.pop(BUDGET, None)
    if differing:
        changes = ", ".join(
            f"{option_name(path)} {new} (the run has {old})" for path, (old, new) in differing.items()
        )
        raise UserError(
            f"--resume continues {command.output} with its own configuration and cannot change {changes}; leave "
            "these options out, or start a new run in another --output"
        )


def _window(command: Command) -> TrainingWindow:
    from wildgs.viewer.serving import TrainingWindow, import_viser

    import_viser()  # reports a missing viser before photos are read
    return TrainingWindow(command.server, command.output.resolve().name, announce=console.print)
