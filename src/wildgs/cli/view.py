"""`wildgs view`: fly through a run in the browser, under any light."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from wildgs.api import load
from wildgs.cli.progress import console
from wildgs.engine.trainer import StepReport, Trainer
from wildgs.errors import UserError
from wildgs.files import printable
from wildgs.scene import Scene
from wildgs.viewer.jobs import start_worker
from wildgs.viewer.server import ServerConfig, address, open_server, public_address
from wildgs.viewer.subject import Subject, TrainingSubject
from wildgs.viewer.training import TrainingTurns
from wildgs.viewer.viewer import Viewer, ViewerConfig

if TYPE_CHECKING:
    from wildgs.viewer.guarded import GuardedServer

VIDEO_FOLDER = "videos"


@dataclass(frozen=True)
class Command:
    """Opens a run in the browser: fly, change the light, stand where photos were taken, record a path.

    Example: wildgs view runs/gate
    """

    run: tyro.conf.Positional[Path]
    """Run folder."""
    appearance: tuple[str, ...] = ()
    """One or two lights to begin with: photos of the scene by name, or files."""
    server: tyro.conf.OmitArgPrefixes[ServerConfig] = field(default_factory=ServerConfig)
    viewer: tyro.conf.OmitArgPrefixes[ViewerConfig] = field(default_factory=ViewerConfig)


def run(command: Command) -> None:
    """Serves the page until interrupted."""
    viewer = open_viewer(command)
    print_address(viewer.server, command.server, f"{command.run}")
    console.print("Ctrl-C ends the viewer")
    stay(viewer)


def open_viewer(command: Command) -> Viewer:
    """Loads the run and builds its page; nothing is drawn until its jobs are worked off.

    Raises:
        UserError: There is no run, no viser, or no such address.
    """
    if len(command.appearance) > 2:
        raise UserError("--appearance takes one or two lights; more are a click away in the viewer")
    server = open_server(command.server, command.run.resolve().name)
    try:
        scene = load(command.run)
        subject = Subject(scene.run.method, scene.scene, scene.appearance)
        status = f"step {scene.run.step:,}, {len(scene.gaussians):,} Gaussians"
        return Viewer(server, subject, command.viewer, command.appearance, status, command.run / VIDEO_FOLDER)
    except BaseException:
        server.stop()
        raise


def print_address(server: GuardedServer, config: ServerConfig, name: str) -> None:
    """Prints where the page is; each address on one line, because its token must be copied whole."""
    for url in (address(server, config), public_address(server, config)):
        if url is not None:
            console.print(f"{printable(name)}: {url}", markup=False, soft_wrap=True)


def stay(viewer: Viewer) -> None:
    """Serves a page whose subject does not change any more, until Ctrl-C."""
    worker = start_worker(viewer.jobs)
    try:
        threading.Event().wait()
    except KeyboardInterrupt:
        console.print("closed")
    finally:
        viewer.close()
        worker.join()


def watch_training(
    trainer: Trainer, scene: Scene, server_config: ServerConfig, title: str
) -> tuple[Viewer, TrainingTurns]:
    """A page on a training run, and the observer that keeps it up to date.

    Raises:
        UserError: There is no viser, or no such address.
    """
    server = open_server(server_config, title)
    try:
        viewer = Viewer(server, TrainingSubject(trainer, scene), ViewerConfig(), status="training starts")
    except BaseException:
        server.stop()
        raise

    def update(report: StepReport) -> None:
        viewer.set_status(
            f"step {report.step:,} of {trainer.config.steps:,}, {report.num_gaussians:,} Gaussians"
        )
        viewer.ask_for_update()

    def watched() -> bool:
        return bool(server.get_clients())

    print_address(server, server_config, "viewer")
    return viewer, TrainingTurns(viewer.jobs, watched, update)
