"""Finds the appearance a user names: a photo of the scene, a new photo, any image, neutral, or a saved file."""

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
from wildgs.light.look import NEUTRAL, Look, look_of, own_look
from wildgs.light.photos import Atlas, KeptAppearances, encode_photo, encode_picture, make_atlas
from wildgs.light.saved import SUFFIX, load_look
from wildgs.model.method import Method
from wildgs.progress import Progress, counter, silent
from wildgs.scene import Scene, View, find_view, match_view
from wildgs.scene.images import UnreadableImageError, read_photo
from wildgs.sfm.feature_index import FeatureIndex, load_feature_index
from wildgs.sfm.localization import LocalizationError, localize

AUTO = "auto"
"""Value of `like`: the training photo with the nearest global embedding."""

KEPT_LOOKS = 16
KEPT_BYTES = 2_000_000_000
"""Bounds on number and memory of cached looks."""


class LightSources:
    """Finds the looks of one scene and caches the last few."""

    def __init__(
        self,
        method: Method,
        open_scene: Callable[[], Scene],
        index_cache: Path | None = None,
        kept: KeptAppearances | None = None,
    ) -> None:
        """Creates the sources of a trained method.

        Args:
            method: The trained method.
            open_scene: Reads the scene, when it is first needed.
            index_cache: File that caches the feature index for localising new photos.
            kept: Appearances of photos of the scene under this method.
        """
        self.method = method
        self.appearances = kept or KeptAppearances()
        self._open_scene = open_scene
        self._index_cache = index_cache
        self._index: FeatureIndex | None = None
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
        """Finds a look.

        The spec is tried in this order: `neutral`; a saved appearance (`*.safetensors`); the name of a photo of the
        scene, with or without extension; an image file. An image file is localised as a new photo of the scene. If
        that fails, with a warning, or if `like` is given, it is used with the camera and depth of a photo of the
        scene.

        Args:
            spec: One of the above.
            like: The photo of the scene whose camera and depth are used for an image file, or `auto` for the most
                similar training photo. None tries to localise it first.
            progress: Called during long work.

        Raises:
            UserError: The photo or file does not exist or cannot be read.
        """
        if not str(spec):
            raise UserError(
                "an appearance without a name: give the name of a photo of the scene, an image file, or 'neutral'"
            )
        if not self.method.relightable:
            if spec != NEUTRAL:
                message = f"{self.method.label} cannot be relit; the appearance {spec} is ignored"
                warnings.warn(message, WildGSWarning, stacklevel=2)
            return self._own
        key = (str(spec), like, _stamp(Path(spec)))
        if key not in self._kept:
            self._kept[key] = self._make(str(spec), like, progress or silent)
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
            return look_of(self.method, self.appearances.of(self.method, view), view.name)
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
                f"{failure}; treated as an image of another place: {look.note} (change it by --like)",
                WildGSWarning,
                stacklevel=4,
            )
        return look

    def _locate(self, file: Path, progress: Progress) -> Look:
        """The look of a new photo of the scene."""
        if self._index is None:
            show = counter(progress, "extracting features of the scene's photos")
            self._index = load_feature_index(self.scene, self._index_cache, show)
        long_side = int(median(max(view.camera.width, view.camera.height) for view in self.scene.views))
        found = localize(file, self._index, long_side)
        appearance = encode_photo(self.method, found.photo, found.camera)
        return look_of(self.method, appearance, file.name, found.describe())

    def _borrow(self, file: Path, like: str, progress: Progress) -> Look:
        """The look of any image with camera and depth of a photo of the scene."""
        picture = read_picture(file)
        lender = find_view(self.scene, like) if like != AUTO else self._most_alike(picture, progress)
        appearance = encode_picture(self.method, picture, lender.camera)
        return look_of(self.method, appearance, file.name, f"uses camera and depth of {lender.name}")

    def _most_alike(self, picture: UInt8[Tensor, "H W 3"], progress: Progress) -> View:
        atlas = self.atlas(progress)
        appearance = encode_picture(self.method, picture, atlas.views[0].camera)
        return atlas.most_alike(self.method.embed(appearance).global_embedding)

    def atlas(self, progress: Progress | None = None) -> Atlas:
        """The appearances of all training photos; cached."""
        if self._atlas is None:
            show = counter(progress, "encoding the photos")
            self._atlas = make_atlas(self.method, self.scene.train_views, show, self.appearances)
        return self._atlas


def read_picture(file: Path) -> UInt8[Tensor, "H W 3"]:
    """Reads an image file, rotated upright by its EXIF orientation.

    Raises:
        UserError: The file cannot be read.
    """
    try:
        return torch.from_numpy(read_photo(file).pixels)
    except UnreadableImageError as error:
        raise UserError(f"{file}: {error}; give a readable image") from error


def _stamp(file: Path) -> tuple[int, ...]:
    """A key that changes when a file is rewritten; empty if there is no file."""
    if not is_file(file):
        return ()
    state = file.stat()
    return state.st_ctime_ns, state.st_mtime_ns, state.st_size, state.st_ino
