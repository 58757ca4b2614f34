"""Appearances of photos of the scene, of other images, and the mean appearance of all training photos."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields

import torch
from jaxtyping import Float, UInt8
from PIL import Image
from torch import Tensor
from torch.nn import functional

from wildgs.geometry.camera import Camera
from wildgs.model.appearance import Appearance, Embeddings
from wildgs.model.method import Method
from wildgs.progress import Counter
from wildgs.scene import View
from wildgs.scene.scene import to_unit
from wildgs.threads import infer_each


@torch.no_grad()
def encode_view(method: Method, view: View) -> Appearance:
    """The appearance of a photo of the scene."""
    device = method.gaussians.means.device
    photo, keep = view.load(device)
    return method.encode(photo, view.camera.to(device), keep, name=view.name)


class KeptAppearances:
    """Appearances of photos of a scene under one trained method, each computed once while memory allows.

    Attributes:
        num_bytes: Memory in use, bytes.
    """

    def __init__(self, limit: int = 2**28) -> None:
        """Creates an empty store.

        Args:
            limit: Limit of the memory in bytes. Appearances that do not fit are computed again at every use.
        """
        self.num_bytes = 0
        self._limit = limit
        self._kept: dict[str, Appearance] = {}

    def keep(self, name: str, appearance: Appearance) -> None:
        """Keeps the appearance of the photo with a name, if it fits."""
        values = (getattr(appearance, each.name) for each in fields(appearance))
        size = sum(value.untyped_storage().nbytes() for value in values if value is not None)
        if name not in self._kept and self.num_bytes + size <= self._limit:
            self._kept[name] = appearance
            self.num_bytes += size

    def of(self, method: Method, view: View) -> Appearance:
        """The appearance of a photo of the scene under the method."""
        if view.name not in self._kept:
            appearance = encode_view(method, view)
            self.keep(view.name, appearance)
            return appearance
        return self._kept[view.name]


@torch.no_grad()
def encode_photo(method: Method, photo: UInt8[Tensor, "H W 3"], camera: Camera) -> Appearance:
    """The appearance of a new photo of the scene with its camera in the aligned frame."""
    device = method.gaussians.means.device
    return method.encode(to_unit(photo, device), camera.to(device))


@torch.no_grad()
def encode_picture(method: Method, picture: UInt8[Tensor, "h w 3"], camera: Camera) -> Appearance:
    """The appearance of any image, as if it were a photo by the camera: style transfer (paper, appendix).

    The image is cropped to the camera's aspect ratio. The mask is not used, since it is not valid for images of
    other scenes.
    """
    device = method.gaussians.means.device
    fitted = cover(picture, camera.width, camera.height)
    return method.encode(to_unit(fitted, device), camera.to(device), trust_mask=False)


def cover(picture: UInt8[Tensor, "h w 3"], width: int, height: int) -> UInt8[Tensor, "H W 3"]:
    """Scales an image and crops it about its centre to fill a frame, without distortion."""
    image = Image.fromarray(picture.numpy())
    scale = max(width / image.width, height / image.height)
    part = (width / scale, height / scale)
    left, top = (image.width - part[0]) / 2, (image.height - part[1]) / 2
    box = (max(left, 0), max(top, 0), min(left + part[0], image.width), min(top + part[1], image.height))
    fitted = image.resize((width, height), Image.Resampling.LANCZOS, box=box)
    return torch.frombuffer(bytearray(fitted.tobytes()), dtype=torch.uint8).reshape(height, width, 3)


MAX_PHOTOS = 200
"""Upper bound on the number of encoded photos, an even selection of larger collections."""


@dataclass(frozen=True)
class Atlas:
    """The appearances of the training photos.

    Attributes:
        views: The photos.
        global_embeddings: Emb^g of each photo.
        mean: Mean of all embeddings and colour maps: the neutral appearance.
    """

    views: tuple[View, ...]
    global_embeddings: Float[Tensor, "V G"]
    mean: Embeddings

    def most_alike(self, global_embedding: Float[Tensor, " G"]) -> View:
        """The photo whose global embedding has the nearest direction; encoded photos keep a part of theirs."""
        likeness = functional.cosine_similarity(self.global_embeddings, global_embedding[None], dim=1)
        return self.views[int(likeness.argmax())]


@torch.no_grad()
def make_atlas(
    method: Method,
    views: Sequence[View],
    progress: Counter | None = None,
    kept: KeptAppearances | None = None,
) -> Atlas:
    """Encodes the training photos (at least one, at most `MAX_PHOTOS`), except those whose appearances are kept."""
    kept = kept or KeptAppearances()
    count = min(len(views), MAX_PHOTOS)
    chosen = tuple(views[index * len(views) // count] for index in range(count))
    global_embeddings: list[Tensor] = []

    def encoded() -> Iterator[Embeddings]:
        each = infer_each(
            lambda view: method.embed(kept.of(method, view)), chosen, method.gaussians.means.device
        )
        for number, embeddings in enumerate(each, start=1):
            global_embeddings.append(embeddings.global_embedding)
            yield embeddings
            if progress is not None:
                progress(number, count)

    mean = method.mean(encoded(), count)
    return Atlas(chosen, torch.stack(global_embeddings), mean)
