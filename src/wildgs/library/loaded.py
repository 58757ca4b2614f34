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
from wildgs.light.look import NEUTRAL, Look, Timeline, mix, with_sky
from wildgs.light.saved import save_look
from wildgs.light.sources import LightSources
from wildgs.model.gaussians import Gaussians
from wildgs.progress import Progress, counter
from wildgs.rasterize import blend
from wildgs.runs import Run, load_run
from wildgs.scene import Scene, View
from wildgs.scene.trajectories import make_path

FEATURE_INDEX_FILE = "feature_index.safetensors"
"""In the run folder: what new photos are localised against, made when the first one comes."""


class LoadedScene:
    """A trained run, ready to be looked at.

    Attributes:
        run: The run: its configuration, trained method and alignment.
    """

    def __init__(self, run: Run) -> None:
        self.run = run
        self._sources = LightSources(run.method, lambda: self.scene, run.folder / FEATURE_INDEX_FILE)

    @property
    def scene(self) -> Scene:
        """The photo collection as the run folder carries it, see `Run.scene`; photos are decoded as needed."""
        return self.run.scene

    @property
    def views(self) -> tuple[View, ...]:
        """The scene's photos with their cameras."""
        return self.scene.views

    @property
    def gaussians(self) -> Gaussians:
        """The Gaussians, in the scene's aligned frame (+z up, the photos' usual depth is 1)."""
        return self.run.method.gaussians

    @property
    def relightable(self) -> bool:
        """Whether photos have a say in the colours; plain 3DGS has one light only."""
        return self.run.method.relightable

    def appearance(
        self, spec: str | Path | Look, *, like: str | None = None, progress: Progress | None = None
    ) -> Look:
        """The light of a photo or anything else that can lend one.

        A run of plain 3DGS has one look, its own, which every call gives.

        Args:
            spec: A photo of the scene by name (with or without its ending); the path of a new photo of the place;
                the path of any picture; `"neutral"` for the mean over the training photos; the path of a saved
                appearance (`*.safetensors`); or a look, which is given back.
            like: For a file: the photo of the scene whose camera and depth it borrows, or `"auto"` for the
                training photo that looks most like it.
            progress: Called with (what is being done, how much of it is done, of how much) during long work.

        Raises:
            UserError: There is no such photo or file, or it cannot be used.
        """
        return spec if isinstance(spec, Look) else self._sources.find(spec, like=like, progress=progress)

    @torch.no_grad()
    def render(self, camera: Camera, look: Look) -> UInt8[Tensor, "H W 3"]:
        """A picture, in main memory; plain 3D Gaussian Splatting once the look is shaded.

        Args:
            camera: In the scene's aligned frame, as `views` have theirs.
            look: From `appearance` or `mix`.

        Raises:
            UserError: The look belongs to another run.
        """
        method = self.run.method
        if look.method is not method:
            raise UserError(f"the appearance {look.name!r} belongs to another run; get it from this one")
        return to_8bit(method.render(camera, look.sh, depth=False).colors).cpu()

    def frames(
        self, cameras: Sequence[Camera], looks: Look | Sequence[Look] | Timeline
    ) -> Iterator[UInt8[Tensor, "H W 3"]]:
        """Pictures along a trajectory, rendered as they are asked for.

        Args:
            cameras: From `path`, or any others in the scene's aligned frame.
            looks: One, or several between which the light changes evenly from the first frame to the last, or a
                timeline.
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
        """Cameras of a video, in the scene's aligned frame.

        Args:
            kind: `orbit`, `training` (past the places of the photos), `spiral`, `views` (through the photos named),
                `still` (the photo named), or the path of a camera file (docs/cameras.md; also nerfstudio's).
            frames: How many; a camera file has its own number.
            size: Width and height of the pictures; None takes the photos' usual size, or the photo's or file's.
            views: Names of photos, for `views` and `still`.

        Raises:
            UserError: There is no such path or photo, or the file cannot be read.
        """
        return make_path(self.scene, kind, frames=frames, size=size, views=views)

    def photo_fits(self, *, scene: Scene | None = None, progress: Progress | None = None) -> list[PhotoFit]:
        """How well each training photo fits, and how much of it its mask hides.

        Training keeps this in RUN/photos.json at its end; photos of a run without the file are inspected now.

        Args:
            scene: With the photos; None takes what the run folder carries.
            progress: Called for every photo inspected.
        """
        photos = read_photos(self.run.folder, self.run.step)
        if photos is None:
            show = counter(progress, "inspecting training photos")
            photos = inspect_photos(self.run.method, scene or self.scene, show)
            write_photos(self.run.folder, self.run.step, photos)
        return photos

    def misfits(self) -> list[PhotoFit]:
        """Training photos that fit no light, worst first: collages, drawings, other places, wrong poses."""
        return find_misfits(self.photo_fits())

    @torch.no_grad()
    def depth(self, camera: Camera) -> Float[Tensor, "H W"]:
        """Expected depth along the camera's z axis, world units, in main memory; 0 where nothing is."""
        projection = self.gaussians.project(camera.to(self.gaussians.means.device))
        return blend(projection, None).depth.cpu()


def load(run: str | Path, device: torch.device | str | None = None) -> LoadedScene:
    """Opens a trained run.

    Args:
        run: The run folder.
        device: Where to render; None takes CUDA where torch has it.

    Raises:
        UserError: The folder holds no run, or no checkpoint yet.
    """
    return LoadedScene(load_run(Path(run), None if device is None else torch.device(device)))


@dataclass(frozen=True)
class SavedAppearance:
    """A written appearance.

    Attributes:
        file: Where it was written.
        look: What it holds.
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
    """Saves the light of a photo, or a mix of several, as a small file that holds no code (safetensors).

    Args:
        run: A run folder, or a loaded scene. The file belongs to the run at its present step.
        photos: What `LoadedScene.appearance` takes; several with weights.
        output: File to write, ending in .safetensors.
        mixing: How several photos become one appearance.
        progress: Called during long work.

    Raises:
        UserError: An appearance cannot be had, there is more than one, or the file cannot be written.
    """
    scene = loaded(run)
    specs = [photos] if isinstance(photos, (str, Path)) else photos
    looks = find_looks(scene, specs, mixing, progress=progress)
    if len(looks) != 1:
        raise UserError(
            f"{len(looks)} appearances do not go into one file; give one, or mix them by --weights"
        )
    return SavedAppearance(save_look(looks[0], Path(output)), looks[0])


def loaded(run: str | Path | LoadedScene) -> LoadedScene:
    """The loaded scene that a user means by a run folder or by itself."""
    return run if isinstance(run, LoadedScene) else load(run)


def find_looks(
    scene: LoadedScene,
    specs: Sequence[str | Path | Look],
    mixing: MixOptions | None = None,
    *,
    progress: Progress | None = None,
) -> list[Look]:
    """The looks of some appearances: one for each, or a single mixed one.

    Args:
        scene: The loaded scene.
        specs: What `LoadedScene.appearance` takes.
        mixing: How they are found and mixed.
        progress: Called during long work.

    Raises:
        UserError: An appearance cannot be had, or the options contradict each other.
    """
    mixing = mixing or MixOptions()

    def find(spec: str | Path | Look) -> Look:
        return scene.appearance(spec, like=mixing.like, progress=progress)

    parts = (mixing.global_, mixing.local)
    if None not in parts:  # both parts come from elsewhere
        if mixing.weights or tuple(specs) not in ((), (NEUTRAL,)):
            raise UserError(
                "--global and --local make the whole appearance; leave --appearance and --weights out"
            )
        specs = ()
    looks = [find(spec) for spec in specs]
    if mixing.weights:
        looks = [mix(looks, mixing.weights)]
    if parts != (None, None):
        if len(looks) > 1:
            raise UserError(
                "--global and --local change one appearance; give one, or --weights to mix several"
            )
        both = [looks[0] if spec is None else find(spec) for spec in parts]
        looks = [mix(both, [1, 0], local_weights=[0, 1])]
    if mixing.sky is None:
        return looks
    sky = find(mixing.sky)
    return [with_sky(look, sky) for look in looks]
