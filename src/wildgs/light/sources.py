"""Where appearance can come from: a photo of the scene, a new one, any picture, the mean, or a file."""

from __future__ import annotations

import warnings
from collections import OrderedDict
from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from statistics import median

import torch
from jaxtyping import UInt8
from torch import Tensor

from wildgs.errors import UserError, WildGSWarning
from wildgs.files import is_file
from wildgs.light.atlas import Atlas, make_atlas
from wildgs.light.look import NEUTRAL, Look, look_of, own_look
from wildgs.light.photos import encode_photo, encode_picture, encode_view
from wildgs.light.saved import SUFFIX, load_look
from wildgs.model.method import Method
from wildgs.scene import Scene, View, find_view, match_view
from wildgs.scene.images import UnreadableImageError, read_photo
from wildgs.sfm.feature_index import FeatureIndex, load_feature_index
from wildgs.sfm.localization import LocalizationError, localize

AUTO = "auto"
"""As `like`: the training photo whose global embedding is nearest."""

KEPT_LOOKS = 16
KEPT_BYTES = 2_000_000_000
"""Looks that are kept with their shaded harmonics, the last used: so many, and within so much memory."""

Progress = Callable[[str, int, int], None]
"""Called with what is being done, how much of it is done, and of how much."""


class LightSources:
    """Finds the looks of one scene by what a user writes, and keeps the last few."""

    def __init__(
        self, method: Method, open_scene: Callable[[], Scene], landmark_cache: Path | None = None
    ) -> None:
        """Sets up `LightSources`.

        Args:
            method: The trained method.
            open_scene: Reads the scene when it is first needed: a saved appearance needs none.
            landmark_cache: File that keeps what new photos are localised against.
        """
        self.method = method
        self._open_scene = open_scene
        self._landmark_cache = landmark_cache
        self._landmarks: FeatureIndex | None = None
        self._kept: OrderedDict[tuple[str, str | None, tuple[int, ...]], Look] = OrderedDict()
        self._atlas: Atlas | None = None

    @cached_property
    def scene(self) -> Scene:
        """The scene with its photos."""
        return self._open_scene()

    @cached_property
    def _own(self) -> Look:
        return own_look(self.method)

    def find(self, spec: str | Path, *, like: str | None = None, progress: Progress | None = None) -> Look:
        """The look that a user asks for.

        In this order: `neutral`; a saved appearance (`*.safetensors`); a photo of the scene by its name, with or
        without its ending; a file. A file is taken for a photo of the place and localised; where that fails (a
        warning says how far it got), and where `like` is given, it is a picture of any kind and borrows a camera.

        Args:
            spec: One of the above.
            like: The photo of the scene whose camera and depth a file borrows, or `auto` for the training photo
                that looks most like it. None tries to localise first.
            progress: Told about long work.

        Raises:
            UserError: There is no such photo or file, or it cannot be read.
        """
        if not self.method.relightable:
            if spec != NEUTRAL:
                message = f"{self.method.label} cannot be relit; the appearance {spec} is ignored"
                warnings.warn(message, WildGSWarning, stacklevel=2)
            return self._own
        key = (str(spec), like, _stamp(Path(spec)))
        if key not in self._kept:
            self._kept[key] = self._make(str(spec), like, progress or _silent)
        self._kept.move_to_end(key)
        size = 4 * 3 * (self.method.sh_degree + 1) ** 2 * self.method.num_gaussians
        while len(self._kept) > max(2, min(KEPT_LOOKS, KEPT_BYTES // max(size, 1))):
            self._kept.popitem(last=False)
        return self._kept[key]

    def _make(self, spec: str, like: str | None, progress: Progress) -> Look:
        if spec == NEUTRAL:
            return Look(NEUTRAL, self.atlas(progress).mean, self.method)
        if spec.endswith(SUFFIX):
            return load_look(self.method, Path(spec))
        view = match_view(self.scene.views, spec)
        if view is not None:
            return look_of(self.method, encode_view(self.method, view), view.name)
        file = Path(spec)
        if not is_file(file):
            raise UserError(
                f"{spec}: is neither a photo of the scene (names are as in its images/ folder), nor a file,"
                f" nor {NEUTRAL!r}"
            )
        if like is None:
            try:
                return self._locate(file, progress)
            except LocalizationError as error:
                failure = str(error)
        else:
            failure = ""
        look = self._borrow(file, like or AUTO, progress)
        if failure:
            warnings.warn(
                f"{failure}; taken for a picture of another place: {look.note} (--like chooses another)",
                WildGSWarning,
                stacklevel=4,
            )
        return look

    def _locate(self, file: Path, progress: Progress) -> Look:
        """The look of a new photo of the place."""
        if self._landmarks is None:
            self._landmarks = load_feature_index(
                self.scene,
                self._landmark_cache,
                lambda done, total: progress("finding features of the scene's photos", done, total),
            )
        long_side = int(median(max(view.camera.width, view.camera.height) for view in self.scene.views))
        found = localize(file, self._landmarks, long_side)
        appearance = encode_photo(self.method, found.photo, found.camera)
        return look_of(self.method, appearance, file.name, found.describe())

    def _borrow(self, file: Path, like: str, progress: Progress) -> Look:
        """The look of any picture, through the camera of a photo of the scene."""
        picture = read_picture(file)
        lender = find_view(self.scene, like) if like != AUTO else self._most_alike(picture, progress)
        appearance = encode_picture(self.method, picture, lender.camera)
        return look_of(self.method, appearance, file.name, f"camera and depth borrowed from {lender.name}")

    def _most_alike(self, picture: UInt8[Tensor, "H W 3"], progress: Progress) -> View:
        atlas = self.atlas(progress)
        appearance = encode_picture(self.method, picture, atlas.views[0].camera)
        return atlas.most_alike(self.method.embed(appearance).global_embedding)

    def atlas(self, progress: Progress | None = None) -> Atlas:
        """The light of all training photos; made once."""
        if self._atlas is None:
            tell = progress or _silent
            self._atlas = make_atlas(
                self.method,
                self.scene.train_views,
                lambda done, total: tell("reading the light of the photos", done, total),
            )
        return self._atlas


def read_picture(file: Path) -> UInt8[Tensor, "H W 3"]:
    """A picture file, upright.

    Raises:
        UserError: It cannot be read.
    """
    try:
        return torch.from_numpy(read_photo(file).pixels)
    except UnreadableImageError as error:
        raise UserError(f"{file}: {error}; give a photo or picture that opens") from error


def _stamp(file: Path) -> tuple[int, ...]:
    """What changes when a file is written again; empty where there is no file."""
    if not is_file(file):
        return ()
    state = file.stat()
    return state.st_ctime_ns, state.st_mtime_ns, state.st_size, state.st_ino


def _silent(*_: object) -> None:
    """No one is told."""
