"""The viewer's page, which connects panels, server and subject.

viser's callbacks run on its own threads; they only change small state and queue jobs. All work on the method is
done by one thread, a worker's or the trainer's between two steps.
"""

from __future__ import annotations

import threading
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from wildgs.errors import UserError
from wildgs.files import printable
from wildgs.model.gaussians import NEAR
from wildgs.scene import View
from wildgs.scene.start import choose_start
from wildgs.viewer.cameras import pose_of
from wildgs.viewer.config import ViewerConfig
from wildgs.viewer.display import Paint, SplatDisplay
from wildgs.viewer.gallery import Gallery, spread
from wildgs.viewer.jobs import Job, Jobs
from wildgs.viewer.lighting import Light, LightDesk, LightPanel, most_different
from wildgs.viewer.markup import escape
from wildgs.viewer.photos import PhotoPanel, compare
from wildgs.viewer.recording import RecordingPanel, free_name, make_film
from wildgs.viewer.subject import Subject

if TYPE_CHECKING:
    import viser

    from wildgs.viewer.guarded import GuardedServer

REPAINT_SECONDS = 0.4
"""Smallest time between updates of colours while the camera moves; each update sends all splats."""
REPAINT_DISTANCE = 0.01
"""Camera movement, relative to the photos' median depth, that changes viewing directions by about half a degree."""
FAR = 1000.0
PAINTS: tuple[Paint, ...] = ("colour", "depth")


class Viewer:
    """The viewer's page for one subject."""

    def __init__(
        self,
        server: GuardedServer,
        subject: Subject,
        config: ViewerConfig,
        lights: Sequence[str] = (),
        status: str = "",
        videos: Path | None = None,
        day: Sequence[str] = (),
    ) -> None:
        """Builds the page.

        Args:
            server: A server with an empty page.
            subject: The scene to show.
            config: Content of the page.
            lights: Up to two initial appearances; missing ones are chosen from the photos.
            status: Status line.
            videos: Folder for videos; None if videos are not available (during training).
            day: Names of the photos of a day, in order; empty if the day is not known.
        """
        self.server, self.subject = server, subject
        self.jobs = Jobs()
        self._lock = threading.Lock()
        self._timer: threading.Timer | None = None
        self._closing = threading.Event()
        self._lit_by: LightDesk | None = None
        self.gallery = Gallery(spread(subject.views, max(config.photos, 1)))
        start, depth = choose_start(subject.scene)
        self._set_start(start, max(depth, 10 * NEAR))
        self.display = SplatDisplay(server, subject, start.camera.position.detach().cpu())
        self._build(lights, status, videos, day)
        server.on_client_connect(self._greet)
        self._ask("light", self._relight)
        self._ask("gallery", self._load_thumbnails)

    def _build(self, lights: Sequence[str], status: str, videos: Path | None, day: Sequence[str]) -> None:
        gui = self.server.gui
        self._status = gui.add_html("")
        self.set_status(status)
        self._paint = gui.add_dropdown("Show", PAINTS, hint="depth: near is bright, far is dark")
        self._paint.on_update(lambda _: self._set_paint(self._paint.value))
        tabs = gui.add_tab_group()
        with tabs.add_tab("Light"):
            self.lighting = LightPanel(
                self.server,
                self._first_desk(lights),
                self.gallery,
                self._light_changed,
                self._nearest_photo,
                self._masks_asked,
                day,
            )
            self.lighting.touched = bool(lights)
        with tabs.add_tab("Photos"):
            self.photos = PhotoPanel(self.server, self.subject.views, self.gallery, self._visited)
        with tabs.add_tab("Path"):
            self.recording = RecordingPanel(self.server, videos, self._film_ordered)

    def _first_desk(self, lights: Sequence[str]) -> LightDesk:
        names = self.gallery.names
        chosen = [*lights, *(name for name in (names[0], names[-1]) if name not in lights)]
        first, second = (chosen * 2)[:2]
        return LightDesk(Light(first, Path(first).name), Light(second, Path(second).name))

    def _nearest_photo(self) -> str:
        """The photo nearest to the camera, whose camera and depth are used for images of other places."""
        positions = torch.stack([view.camera.position.cpu() for view in self.subject.views])
        return self.subject.views[int((positions - self.display.eye).norm(dim=1).argmin())].name

    def _set_start(self, view: View, distance: float) -> None:
        pose, camera = pose_of(view.camera), self.server.initial_camera
        camera.position = pose.position
        camera.look_at = pose.position + distance * view.camera.forward.double().cpu().numpy()
        camera.up = np.array([0.0, 0.0, 1.0])
        camera.fov, camera.near, camera.far = pose.fov, NEAR, FAR

    # Called on viser's threads: change state and queue jobs.

    def _greet(self, client: viser.ClientHandle) -> None:
        client.camera.on_update(self._camera_moved)

    def _camera_moved(self, camera: Any) -> None:
        eye = torch.from_numpy(np.asarray(camera.position, dtype=np.float64)).float()
        if (eye - self.display.eye).norm() < REPAINT_DISTANCE:
            return
        self.display.eye = eye
        with self._lock:
            if self._timer is None:
                self._timer = threading.Timer(REPAINT_SECONDS, self._repaint_soon)
                self._timer.daemon = True
                self._timer.start()

    def _repaint_soon(self) -> None:
        with self._lock:
            self._timer = None
        self._ask("paint", self.display.repaint)

    def _set_paint(self, paint: Paint) -> None:
        self.display.paint = paint
        self._ask("paint", self.display.repaint)

    def _light_changed(self) -> None:
        self._ask("light", self._relight)

    def _visited(self, view: View) -> None:
        self._ask("compare", self._compare)

    def _film_ordered(self, client: viser.ClientHandle | None) -> None:
        self._ask("film", lambda: self._film(client))

    def _masks_asked(self, shown: bool) -> None:
        self.gallery.show_masks(shown)
        if shown:
            self._ask("masks", self._mask_thumbnails)

    def ask_for_update(self) -> None:
        """Queues an update of the Gaussians, the light and the comparison to the subject's current state."""
        self._ask("light", self._relight)
        if self.gallery.masks:
            self._masks_asked(True)
        if self.photos.current is not None:
            self._ask("compare", self._compare)

    def set_status(self, text: str) -> None:
        """Sets the status line."""
        self._status.content = f'<div style="font-size:12px;margin:2px 12px 6px">{escape(text)}</div>'

    def show_error(self, message: str) -> None:
        """Notifies all clients of an error."""
        for client in self.server.get_clients().values():
            client.add_notification("Failed", printable(message), color="red", auto_close_seconds=15)

    def _ask(self, kind: str, job: Job) -> None:
        self.jobs.put(kind, lambda: self._try(job))

    # Called on the thread that does the jobs.

    def _try(self, job: Job) -> None:
        """Does a job; its failure must not stop the worker or the training."""
        try:
            job()
        except UserError as error:
            self.show_error(str(error))
        except Exception as error:
            if self._closing.is_set():
                return  # the server and the panels may be closed already
            traceback.print_exc()
            self.show_error(f"{type(error).__name__} in the viewer; see its terminal for details")

    def _relight(self) -> None:
        desk = self.lighting.desk
        try:
            look = desk.look(self.subject)
        except UserError:
            if self._lit_by is not None and self._lit_by != desk:
                self.lighting.take_back(self._lit_by)
            raise
        self._lit_by = desk
        self.display.show(look)
        if self.photos.current is not None and not self.photos.own_light.value:
            self._ask("compare", self._compare)

    def _compare(self) -> None:
        view = self.photos.current
        if view is not None:
            own = self.photos.own_light.value
            look = self.subject.look(view.name) if own else self.lighting.desk.look(self.subject)
            self.photos.show(compare(self.subject, view, look))

    def _film(self, client: viser.ClientHandle | None) -> None:
        panel = self.recording
        if panel.folder is None:
            return
        order = panel.order()

        def report(done: int, total: int) -> bool:
            if done % 5 == 0 or done == total:
                panel.tell(f"frame {done} of {total}")
            return not self._closing.is_set()

        try:
            file = make_film(self.subject, self.lighting.desk, order, free_name(panel.folder), report)
        except Exception:
            panel.tell("the video failed")
            raise
        panel.tell(f"written: {file}")
        if client is not None:
            client.send_file_download(file.name, file.read_bytes())

    def _load_thumbnails(self) -> None:
        if self.gallery.load_some():
            self._ask("gallery", self._load_thumbnails)
        elif self.subject.relightable and (colors := self.gallery.mean_colors()):
            first = next(iter(colors))
            self.lighting.suggest(first, most_different(colors, first))

    def _mask_thumbnails(self) -> None:
        try:
            more = self.gallery.mask_some(self.subject.visibility)
        except UserError:
            self.lighting.masks.value = False
            raise
        if more:
            self._ask("masks", self._mask_thumbnails)

    def close(self) -> None:
        """Stops the queue and the server."""
        self._closing.set()
        self.jobs.close()
        with self._lock:
            if self._timer is not None:
                self._timer.cancel()
        self.lighting.close()
        self.server.stop()
