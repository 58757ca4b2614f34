"""The content of the viewer: a trained method with its photos, or one in training."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from wildgs.engine.trainer import Trainer
from wildgs.evaluation.metrics import to_8bit
from wildgs.geometry.camera import Camera
from wildgs.light.look import NEUTRAL, Look, look_of
from wildgs.light.sources import LightSources
from wildgs.model.method import Method
from wildgs.rasterize import Rendering
from wildgs.scene import Scene, View, match_view


class Subject:
    """A trained method with its photos."""

    def __init__(self, method: Method, scene: Scene, find_look: Callable[..., Look] | None = None) -> None:
        """Creates the subject; `find_look` defaults to `LightSources.find`."""
        self.method = method
        self.scene = scene
        self.sh_degree = method.sh_degree
        self._find_look = find_look or LightSources(method, lambda: scene).find

    @property
    def views(self) -> tuple[View, ...]:
        """All photos with their cameras."""
        return self.scene.views

    @property
    def relightable(self) -> bool:
        """Whether the method's colours depend on an appearance."""
        return self.method.relightable

    @property
    def device(self) -> torch.device:
        """The method's device."""
        return self.method.gaussians.means.device

    @property
    def version(self) -> int:
        """Changes whenever the method changes."""
        return 0

    def look(self, spec: str | Path, like: str | None = None) -> Look:
        """The look of a photo by name, or of an image file, for which the camera of the photo `like` is used.

        Raises:
            UserError: The photo or file does not exist or cannot be read.
        """
        return self._find_look(spec if self.relightable else NEUTRAL, like=like)

    @torch.no_grad()
    def visibility(self, view: View) -> Float[Tensor, "H W"] | None:
        """The mask M of a photo (1 = static) on the CPU; None for a method that predicts no mask."""
        visibility = self.method.visibility(view.load(self.device)[0])
        return None if visibility is None else visibility.float().cpu()

    @torch.no_grad()
    def render(self, camera: Camera, look: Look) -> tuple[UInt8[Tensor, "H W 3"], Rendering]:
        """Renders an 8-bit image on the CPU, and the rendering with depth and alpha."""
        rendering = self.method.render(camera, look.sh, sh_degree=self.sh_degree)
        return to_8bit(rendering.colors).cpu(), rendering


class TrainingSubject(Subject):
    """A method in training, rendered between two steps at the current stage of its schedule."""

    def __init__(self, trainer: Trainer, scene: Scene) -> None:
        """Creates the subject; none of its methods may be called during a training step."""
        super().__init__(trainer.method, scene)
        self._trainer = trainer
        self._explicit = True
        self._step = -1
        self._catch_up()

    @property
    def version(self) -> int:
        """The number of steps done."""
        return self._trainer.step

    def _catch_up(self) -> None:
        """Discards looks of earlier steps, when the Gaussians may have been different, and updates the stage."""
        if self._step == self._trainer.step:
            return
        self._step = self._trainer.step
        stage = self._trainer.schedule.stage(self._step, self.method.sh_degree)
        self.sh_degree, self._explicit = stage.sh_degree, stage.explicit
        self._find_look = LightSources(self.method, lambda: self.scene).find

    def look(self, spec: str | Path, like: str | None = None) -> Look:
        """As `Subject.look`, without local appearance in the first stage of training."""
        self._catch_up()
        with self._inference():
            if self._explicit or not self.relightable:
                return super().look(spec, like)
            view = match_view(self.views, str(spec)) or match_view(self.views, like or "") or self.views[0]
            with torch.no_grad():
                photo, camera = view.load(self.device)[0], view.camera.to(self.device)
                appearance = self.method.encode(photo, camera, name=view.name, explicit=False)
                return look_of(self.method, appearance, view.name)

    def visibility(self, view: View) -> Float[Tensor, "H W"] | None:
        """As `Subject.visibility`."""
        with self._inference():
            return super().visibility(view)

    @contextmanager
    def _inference(self) -> Iterator[None]:
        training = self.method.training
        self.method.eval()
        try:
            yield
        finally:
            self.method.train(training)
