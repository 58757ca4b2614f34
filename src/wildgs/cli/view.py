"""`wildgs view`: fly through a run in the browser, under any light."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field
from pathlib import Path

import tyro

from wildgs.api import load
from wildgs.cli.progress import console
from wildgs.errors import UserError
from wildgs.viewer.jobs import start_worker
from wildgs.viewer.server import ServerConfig, address, open_server
from wildgs.viewer.subject import Subject
from wildgs.viewer.viewer import Viewer, ViewerConfig


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
    start_worker(viewer.jobs)
    console.print(f"{command.run}: {address(viewer.server, command.server)}  (Ctrl-C ends it)")
    wait_for_interrupt(viewer)


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
        subject = Subject(scene.run.method, scene.scene)
        status = f"step {scene.run.step:,}, {len(scene.gaussians):,} Gaussians"
        return Viewer(server, subject, command.viewer, command.appearance, status)
    except BaseException:
        server.stop()
        raise


def wait_for_interrupt(viewer: Viewer) -> None:
    """Keeps the program alive until Ctrl-C."""
    try:
        threading.Event().wait()
    except KeyboardInterrupt:
        console.print("closed")
    finally:
        viewer.close()
