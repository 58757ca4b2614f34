"""`wildgs.view`, and the viewer beside a training: a page opened, kept up to date and closed."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from wildgs.engine.trainer import Observer, StepReport, Trainer
from wildgs.errors import UserError
from wildgs.library.loaded import LoadedScene, load
from wildgs.processes import TerminatedError, signals_as_interrupts
from wildgs.scene import Scene
from wildgs.viewer.config import ServerConfig, ViewerConfig
from wildgs.viewer.jobs import start_worker
from wildgs.viewer.server import address, open_server, public_address
from wildgs.viewer.subject import Subject, TrainingSubject
from wildgs.viewer.training import TrainingTurns
from wildgs.viewer.viewer import Viewer

if TYPE_CHECKING:
    from wildgs.viewer.guarded import GuardedServer

VIDEO_FOLDER = "videos"

# pycolmap sets a SIGTERM handler of its own when it is imported, which localisation does at its first use: here it
# comes before our handlers, and after what `wildgs.scene` has to load before it.
import_module("pycolmap")


class OpenViewer:
    """A run's page that is being served.

    Attributes:
        viewer: The page.
        urls: Where it is reached.
    """

    def __init__(self, viewer: Viewer, urls: Sequence[str]) -> None:
        """Sets up an `OpenViewer`; `view` opens one."""
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
        page = Viewer(opened, subject, viewer or ViewerConfig(), appearance, status, folder / VIDEO_FOLDER)
    except BaseException:
        opened.stop()
        raise
    return OpenViewer(page, addresses(opened, config))


def addresses(server: GuardedServer, config: ServerConfig) -> list[str]:
    """What to type into a browser: on this machine, and anywhere where the page is shared."""
    found = (address(server, config), public_address(server, config))
    return [url for url in found if url is not None]


class TrainingWindow:
    """A page beside a training: it shows the training while it runs, and what was trained afterwards."""

    def __init__(self, server: ServerConfig, title: str, announce: Callable[[str], None]) -> None:
        """Sets up a `TrainingWindow`.

        Args:
            server: Where the page is reached.
            title: Stands above the controls.
            announce: Called with a line that says where the page is.
        """
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
        """Keeps showing what was trained, until Ctrl-C."""
        if self._open is not None:
            self._open.viewer.set_status(self._status)
            self._open.viewer.ask_for_update()
            self._open.stay()
