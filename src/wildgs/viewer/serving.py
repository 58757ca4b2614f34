"""`wildgs.view`, and the viewer during training: starting and stopping the server, and its URLs."""

from __future__ import annotations

import contextlib
import importlib
import io
import socket
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

import numpy as np

from wildgs.engine.report import Observer, StepReport
from wildgs.engine.trainer import Trainer
from wildgs.errors import UserError
from wildgs.files import printable
from wildgs.library.day import known_day
from wildgs.library.loaded import LoadedScene, load
from wildgs.processes import TerminatedError, signals_as_interrupts
from wildgs.scene import Scene
from wildgs.viewer.config import LOCAL, ServerConfig, ViewerConfig
from wildgs.viewer.jobs import TrainingTurns, start_worker
from wildgs.viewer.subject import Subject, TrainingSubject
from wildgs.viewer.viewer import Viewer

if TYPE_CHECKING:
    from wildgs.viewer.guarded import GuardedServer

REMEDY = "the viewer needs viser: pip install 'wildgs[viewer]'"


def open_server(config: ServerConfig, title: str) -> GuardedServer:
    """Starts an empty viewer page with a title.

    Raises:
        UserError: viser is not installed, this machine does not have the address, or sharing failed.
    """
    import_viser()
    from wildgs.viewer.guarded import GuardedServer

    _check_address(config)
    with contextlib.redirect_stdout(io.StringIO()):  # hides viser's start message
        server = GuardedServer(config.host, config.port, share=config.share)
    if config.share:
        public = server.request_share_url(verbose=False)
        if public is None:
            server.stop()
            raise UserError(
                "viser's relay did not provide a public URL; leave out --share and use the local URL"
            )
        server.access.allow_name(urlsplit(public).hostname or "")
    # viser's share dialog would show the public URL without the token.
    server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
    server.gui.set_panel_label(printable(title))
    server.scene.set_up_direction("+z")
    # A black background as in the rasteriser.
    server.scene.set_background_image(np.zeros((2, 2, 3), dtype=np.uint8), format="png")
    return server


def address(server: GuardedServer, config: ServerConfig) -> str:
    """The URL for a browser on this machine, including the token."""
    host = LOCAL if config.host in ("0.0.0.0", "::", "") else config.host
    local = f"http://{f'[{host}]' if ':' in host else host}:{server.get_port()}"
    return f"{local}/{server.access.token}/"


def public_address(server: GuardedServer, config: ServerConfig) -> str | None:
    """The URL at viser's relay; None unless the viewer is shared."""
    public = server.request_share_url(verbose=False) if config.share else None
    return None if public is None else f"{public.rstrip('/')}/{server.access.token}/"


def import_viser():
    """Imports viser, an optional dependency; raises `UserError` if it is not installed."""
    try:
        return importlib.import_module("viser")
    except ModuleNotFoundError as error:
        if error.name != "viser":
            raise
        raise UserError(REMEDY) from error


def _check_address(config: ServerConfig) -> None:
    """Rejects an invalid address, for which viser would try a thousand ports."""
    if not 0 <= config.port <= 65535:
        raise UserError(f"--port {config.port}: must be from 0 to 65535; 0 selects a free port")
    try:
        family, kind, protocol, _, target = socket.getaddrinfo(config.host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as trial:
            trial.bind(target)
    except OSError as error:
        raise UserError(
            f"--host {config.host}: this machine does not have this address; use {LOCAL} for local access only, "
            "0.0.0.0 for all interfaces"
        ) from error


VIDEO_FOLDER = "videos"

# pycolmap installs a SIGTERM handler when it is imported. It is imported here, before our handlers are installed,
# instead of at the first localisation.
import_module("pycolmap")


class OpenViewer:
    """A viewer page served at `urls`, opened by `view`."""

    def __init__(self, viewer: Viewer, urls: Sequence[str]) -> None:
        self.viewer, self.urls = viewer, tuple(urls)
        self._worker: threading.Thread | None = None

    def start(self) -> None:
        """Serves in the background."""
        if self._worker is None:
            self._worker = start_worker(self.viewer.jobs)

    def stay(self) -> None:
        """Serves until Ctrl-C, then closes the page.

        Raises:
            TerminatedError: SIGTERM or SIGHUP arrived; the page is closed.
        """
        self.start()
        with signals_as_interrupts():
            try:
                threading.Event().wait()
            except TerminatedError:
                raise
            except KeyboardInterrupt:
                pass
            finally:
                self.close()

    def close(self) -> None:
        """Closes the page."""
        self.viewer.close()
        if self._worker is not None:
            self._worker.join()


def view(
    run: str | Path | LoadedScene,
    *,
    appearance: Sequence[str] = (),
    server: ServerConfig | None = None,
    viewer: ViewerConfig | None = None,
) -> OpenViewer:
    """Opens a run in the browser: navigate, change the light, jump to the photos' viewpoints, record a camera path.

    Args:
        run: A run folder, or a loaded scene.
        appearance: One or two initial appearances.
        server: Network address.
        viewer: Content of the page.

    Returns:
        The open page; `start` serves it in the background, `stay` until Ctrl-C.

    Raises:
        UserError: The run does not exist, viser is not installed, or the address is invalid.
    """
    if len(appearance) > 2:
        raise UserError("--appearance takes one or two lights; the viewer offers the others")
    config = server or ServerConfig()
    folder = run.run.folder if isinstance(run, LoadedScene) else Path(run)
    opened = open_server(config, folder.resolve().name)
    try:
        scene = run if isinstance(run, LoadedScene) else load(run)
        subject = Subject(scene.run.method, scene.scene, scene.appearance)
        status = f"step {scene.run.step:,}, {len(scene.gaussians):,} Gaussians"
        day, videos = known_day(scene), folder / VIDEO_FOLDER
        keys = day.keys if day else ()
        page = Viewer(opened, subject, viewer or ViewerConfig(), appearance, status, videos, keys)
    except BaseException:
        opened.stop()
        raise
    return OpenViewer(page, addresses(opened, config))


def addresses(server: GuardedServer, config: ServerConfig) -> list[str]:
    """The URLs of the page: the local one, and the public one if the page is shared."""
    found = (address(server, config), public_address(server, config))
    return [url for url in found if url is not None]


class TrainingWindow:
    """A viewer page that shows training while it runs, and its result afterwards."""

    def __init__(self, server: ServerConfig, title: str, announce: Callable[[str], None]) -> None:
        """Sets the page's network address and title; `announce` prints its URLs."""
        self._config, self._title, self._announce = server, title, announce
        self._open: OpenViewer | None = None
        self._status = ""

    @contextmanager
    def attach(self, trainer: Trainer, scene: Scene) -> Iterator[Observer]:
        """Shows a training (`wildgs.train(attach=[window.attach])`); the page stays open unless it fails.

        Raises:
            UserError: viser is not installed, or the address is invalid.
        """
        server = open_server(self._config, self._title)
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

        urls = addresses(server, self._config)
        for url in urls:
            self._announce(f"viewer: {url}")
        try:
            yield TrainingTurns(viewer.jobs, lambda: bool(server.get_clients()), update)
        except BaseException:
            viewer.close()
            raise
        self._open = OpenViewer(viewer, urls)
        self._status = f"trained {trainer.step:,} steps, {len(trainer.method.gaussians):,} Gaussians"

    def stay(self) -> None:
        """Shows the result until Ctrl-C."""
        if self._open is not None:
            self._open.viewer.set_status(self._status)
            self._open.viewer.ask_for_update()
            self._open.stay()
