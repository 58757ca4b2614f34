"""The Python API: one trained scene under any appearance, from any camera.

scene = wildgs.load("runs/gate")
look = scene.appearance("evening.jpg")
image = scene.render(scene.views[0].camera, look)
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from wildgs.errors import UserError
from wildgs.evaluation.metrics import to_8bit
from wildgs.evaluation.photos import PhotoFit, find_misfits, inspect_photos, read_photos, write_photos
from wildgs.geometry.camera import Camera
from wildgs.library.config import MixOptions
from wildgs.light.look import NEUTRAL, Look, Timeline, mix, require_look, with_sky
from wildgs.light.photos import KeptAppearances
from wildgs.light.saved import SUFFIX, save_look
from wildgs.light.sources import LightSources
from wildgs.model.appearance import Appearance
from wildgs.model.gaussians import Gaussians
from wildgs.progress import Progress, counter
from wildgs.rasterize import blend
from wildgs.runs import Run, load_run
from wildgs.scene import Scene, View, match_view
from wildgs.scene.trajectories import make_path

Spec = str | Path | Look
"""What `LoadedScene.appearance` accepts."""

FEATURE_INDEX_FILE = "feature_index.safetensors"
"""Feature index in the run folder, created when the first new photo is localised."""


class LoadedScene:
    """A trained run, ready for rendering.

    Attributes:
        run: The run: its configuration, trained method and alignment.
    """

    def __init__(self, run: Run, appearances: KeptAppearances | None = None) -> None:
        """Wraps a run.

        Args:
            run: The run.
            appearances: Appearances of its photos that are known already, such as those of the training.
        """
        self.run = run
        self._appearances = appearances or KeptAppearances()
        index = run.folder / FEATURE_INDEX_FILE
        self._sources = LightSources(run.method, lambda: self.scene, index, self._appearances)

    @property
    def scene(self) -> Scene:
        """The photo collection as stored in the run folder (`Run.scene`); photos are decoded on demand."""
        return self.run.scene

    @property
    def views(self) -> tuple[View, ...]:
        """The scene's photos with their cameras."""
        return self.scene.views

    @property
    def gaussians(self) -> Gaussians:
        """The Gaussians, in the aligned frame (+z up, median depth of the photos = 1)."""
        return self.run.method.gaussians

    @property
    def relightable(self) -> bool:
        """Whether colours depend on an appearance; False for plain 3DGS."""
        return self.run.method.relightable

    def appearance(
        self, spec: str | Path | Look, *, like: str | None = None, progress: Progress | None = None
    ) -> Look:
        """The appearance of a photo or another source.

        Plain 3DGS cannot be relit: every call returns its only look.

        Args:
            spec: Name of a photo of the scene (with or without extension); path of a new photo of the scene or of
                any other image; `"neutral"` for the mean over the training photos; path of a saved appearance
                (`*.safetensors`); or a look, which is returned unchanged.
            like: For an image file: the photo of the scene whose camera and depth are used, or `"auto"` for the
                most similar training photo.
            progress: Called during long work.

        Raises:
            UserError: The photo or file does not exist or cannot be used.
        """
        return spec if isinstance(spec, Look) else self._sources.find(spec, like=like, progress=progress)

    def encode(self, view: View) -> Appearance:
        """The appearance of a photo of the scene, computed once while memory allows."""
        return self._appearances.of(self.run.method, view)

    @torch.no_grad()
    def render(self, camera: Camera, look: Look) -> UInt8[Tensor, "H W 3"]:
        """Renders an image, returned on the CPU.

        Args:
            camera: A camera in the aligned frame, like those of `views`.
            look: From `appearance` or `mix`. Its first use computes all colours; further renders are plain 3DGS,
                with the response of the photo's camera if the run fits one.

        Raises:
            UserError: The look belongs to another run, or is the name of one.
        """
        require_look(look)
        method = self.run.method
        if look.method is not method:
            raise UserError(f"the appearance {look.name!r} belongs to another run; obtain it from this one")
        return to_8bit(
            method.render(camera, look.sh, depth=False, response=look.embeddings.response).colors
        ).cpu()

    def frames(
        self, cameras: Sequence[Camera], looks: Look | Sequence[Look] | Timeline
    ) -> Iterator[UInt8[Tensor, "H W 3"]]:
        """Renders images along a trajectory, one at a time.

        Args:
            cameras: From `path`, or any others in the aligned frame.
            looks: One look; or several, between which the light changes evenly from the first frame to the last; or
                a timeline.
        """
        timeline = Timeline.of(looks)
        last = max(len(cameras) - 1, 1)
        for number, camera in enumerate(cameras):
            yield self.render(camera, timeline.at(number / last))

    def path(
        self,
        kind: str | Path,
        *,
        frames: int = 150,
        size: tuple[int, int] | None = None,
        views: Sequence[str] = (),
    ) -> list[Camera]:
        """Cameras along a path, in the aligned frame.

        Args:
            kind: `orbit`, `training` (along the camera positions of the photos), `spiral`, `views` (through the
                photos in `views`), `still` (at the photo in `views`), or a camera file (docs/cameras.md; also
                nerfstudio's).
            frames: Number of cameras; a camera file has its own.
            size: Width and height in pixels; None takes that of the file, the still's photo, or the typical photo.
            views: Names of photos, for `views` and `still`.

        Raises:
            UserError: The path or a photo does not exist, or the file cannot be read.
        """
        return make_path(self.scene, kind, frames=frames, size=size, views=views)

    def photo_fits(self, *, scene: Scene | None = None, progress: Progress | None = None) -> list[PhotoFit]:
        """How well each training photo fits its render, and how much of it the mask hides.

        Training writes this to RUN/photos.json; if the file is missing, it is computed.

        Args:
            scene: The scene with its photos; None takes the copies in the run folder.
            progress: Called for every photo.
        """
        photos = read_photos(self.run.folder, self.run.step)
        if photos is None:
            show = counter(progress, "inspecting training photos")
            keep = self._appearances.keep
            photos = inspect_photos(self.run.method, scene or self.scene, show, keep)
            write_photos(self.run.folder, self.run.step, photos)
        return photos

    def misfits(self) -> list[PhotoFit]:
        """Training photos that no appearance explains (collages, drawings, wrong poses), worst first."""
        return find_misfits(self.photo_fits())

    @torch.no_grad()
    def depth(self, camera: Camera) -> Float[Tensor, "H W"]:
        """Expected depth along the camera's z axis in units of the aligned frame, on the CPU; 0 where empty."""
        projection = self.gaussians.project(camera.to(self.gaussians.means.device))
        return blend(projection, None).depth.cpu()


def load(run: str | Path, device: torch.device | str | None = None) -> LoadedScene:
    """Loads a trained run.

    Args:
        run: The run folder.
        device: Device for rendering. Default: CUDA if available, else the CPU.

    Raises:
        UserError: The folder is not a run folder, or has no checkpoint yet.
    """
    # Absolute, so that the scene does not follow the working directory of the process.
    return LoadedScene(load_run(Path(run).absolute(), None if device is None else torch.device(device)))


@dataclass(frozen=True)
class SavedAppearance:
    """A saved appearance.

    Attributes:
        file: The file.
        look: The appearance in it.
    """

    file: Path
    look: Look


def appearance(
    run: str | Path | LoadedScene,
    photos: str | Path | Sequence[str | Path],
    output: str | Path,
    *,
    mixing: MixOptions | None = None,
    progress: Progress | None = None,
) -> SavedAppearance:
    """Saves the appearance of a photo, or a mix of several, as a small safetensors file.

    Args:
        run: A run folder, or a loaded scene. The file is valid for this run at its current step.
        photos: Anything that `LoadedScene.appearance` accepts; several with weights.
        output: File to write (.safetensors).
        mixing: How several photos are mixed into one appearance.
        progress: Called during long work.

    Raises:
        UserError: An appearance cannot be obtained, there is more than one, or the file cannot be written.
    """
    scene = loaded(run)
    specs = [photos] if isinstance(photos, (str, Path)) else photos
    looks = find_looks(scene, specs, mixing, progress=progress)
    if len(looks) != 1:
        raise UserError(
            f"{len(looks)} appearances do not fit into one file; give one, or mix them by --weights"
        )
    return SavedAppearance(save_look(looks[0], Path(output)), looks[0])


def loaded(run: str | Path | LoadedScene) -> LoadedScene:
    """The scene itself, or that loaded from a run folder."""
    return run if isinstance(run, LoadedScene) else load(run)


def folder_of(run: str | Path | LoadedScene) -> Path:
    """The run folder, as given."""
    return run.run.folder if isinstance(run, LoadedScene) else Path(run)


def without_repeats(
    scene: LoadedScene, specs: Spec | Sequence[Spec], mixing: MixOptions | None = None
) -> list[Spec]:
    """Specs of appearances in their order, each once, unless they have weights."""
    specs = [specs] if isinstance(specs, str | Path | Look) else list(specs)
    if mixing and mixing.weights:
        return specs
    once: dict[str | Look, Spec] = {}
    for spec in specs if scene.relightable else specs[:1]:
        once.setdefault(_key(scene, spec), spec)
    return list(once.values())


def _key(scene: LoadedScene, spec: Spec) -> str | Look:
    """What specs of the same appearance have in common: photos may be named with or without extension."""
    if isinstance(spec, Look):
        return spec
    if spec == NEUTRAL or str(spec).endswith(SUFFIX):
        return str(spec)
    view = match_view(scene.views, str(spec))
    return str(spec) if view is None else view.name


def find_looks(
    scene: LoadedScene,
    specs: Spec | Sequence[Spec],
    mixing: MixOptions | None = None,
    *,
    progress: Progress | None = None,
) -> list[Look]:
    """Obtains one look for each spec, or a single mixed one.

    Args:
        scene: The loaded scene.
        specs: Anything that `LoadedScene.appearance` accepts, or several.
        mixing: How they are obtained and mixed.
        progress: Called during long work.

    Raises:
        UserError: An appearance cannot be obtained, or the options contradict each other.
    """
    mixing = mixing or MixOptions()
    if isinstance(specs, str | Path | Look):
        specs = (specs,)

    def find(spec: Spec) -> Look:
        return scene.appearance(spec, like=mixing.like, progress=progress)

    parts = (mixing.global_, mixing.local)
    if None not in parts:
        if mixing.weights or tuple(specs) not in ((), (NEUTRAL,)):
            raise UserError(
                "--global and --local together define the appearance; leave out --appearance and --weights"
            )
        specs = ()
    looks = [find(spec) for spec in specs]
    if mixing.weights:
        looks = [mix(looks, mixing.weights)]
    if parts != (None, None):
        if len(looks) > 1:
            raise UserError(
                "--global and --local modify one appearance; give one, or mix several by --weights"
            )
        both = [looks[0] if spec is None else find(spec) for spec in parts]
        looks = [mix(both, [1, 0], local_weights=[0, 1])]
    if mixing.sky is None:
        return looks
    sky = find(mixing.sky)
    return [with_sky(look, sky) for look in looks]
