"""`wildgs.view`, and the viewer of a training: the server, its address, and the life of a page."""

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

from wildgs.engine.trainer import Observer, StepReport, Trainer
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
        UserError: viser is not installed, the address is not one of this machine's, or sharing failed.
    """
    import_viser()
    from wildgs.viewer.guarded import GuardedServer

    _check_address(config)
    with contextlib.redirect_stdout(io.StringIO()):  # viser greets in a box of its own
        server = GuardedServer(config.host, config.port, share=config.share)
    if config.share:
        public = server.request_share_url(verbose=False)
        if public is None:
            server.stop()
            raise UserError(
                "viser's relay gave no public address; leave --share out and use the local address"
            )
        server.access.allow_name(urlsplit(public).hostname or "")
    # viser's own share dialog would show the public address without the token.
    server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
    server.gui.set_panel_label(printable(title))
    server.scene.set_up_direction("+z")
    # What no Gaussian covers is black, as the rasteriser has it.
    server.scene.set_background_image(np.zeros((2, 2, 3), dtype=np.uint8), format="png")
    return server


def address(server: GuardedServer, config: ServerConfig) -> str:
    """The address for a browser on this machine, with the viewer's token."""
    host = LOCAL if config.host in ("0.0.0.0", "::", "") else config.host
    local = f"http://{f'[{host}]' if ':' in host else host}:{server.get_port()}"
    return f"{local}/{server.access.token}/"


def public_address(server: GuardedServer, config: ServerConfig) -> str | None:
    """The address at viser's relay, None unless the viewer is shared."""
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
    """Rejects an impossible address, for which viser would try a thousand ports."""
    if not 0 <= config.port <= 65535:
        raise UserError(f"--port {config.port}: ports are 0 to 65535, 0 for any free one")
    try:
        family, kind, protocol, _, target = socket.getaddrinfo(config.host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as trial:
            trial.bind(target)
    except OSError as error:
        raise UserError(
            f"--host {config.host}: this machine has no such address; use {LOCAL} for local access only,"
            " 0.0.0.0 for all interfaces"
        ) from error


VIDEO_FOLDER = "videos"

# pycolmap sets a SIGTERM handler of its own when it is imported, which localisation does at its first use: here it
# comes before our handlers, and after what `wildgs.scene` has to load before it.
import_module("pycolmap")


class OpenViewer:
    """A page that is being served at `urls`; use `view` to open one."""

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
            TerminatedError: SIGTERM or SIGHUP came; the page is closed.
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
    """Opens a run in the browser: fly, change the light, stand where photos were taken, record a path.

    Args:
        run: A run folder, or a loaded scene.
        appearance: One or two lights to begin with.
        server: Where the page is reached.
        viewer: What is shown.

    Returns:
        The open page; `start` serves it in the background, `stay` until Ctrl-C.

    Raises:
        UserError: There is no run, no viser, or no such address.
    """
    if len(appearance) > 2:
        raise UserError("--appearance takes one or two lights; more can be chosen in the viewer")
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
    """The addresses of the page: on this machine, and the public one if the page is shared."""
    found = (address(server, config), public_address(server, config))
    return [url for url in found if url is not None]


class TrainingWindow:
    """A page that shows a training while it runs, and its result afterwards."""

    def __init__(self, server: ServerConfig, title: str, announce: Callable[[str], None]) -> None:
        """Takes the page's address and title, and a function that prints where the page is."""
        self._config, self._title, self._announce = server, title, announce
        self._open: OpenViewer | None = None
        self._status = ""

    @contextmanager
    def attach(self, trainer: Trainer, scene: Scene) -> Iterator[Observer]:
        """Shows a training (`wildgs.train(attach=[window.attach])`); the page outlives it unless it fails.

        Raises:
            UserError: There is no viser, or no such address.
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
        """Keeps showing the result, until Ctrl-C."""
        if self._open is not None:
            self._open.viewer.set_status(self._status)
            self._open.viewer.ask_for_update()
            self._open.stay()
