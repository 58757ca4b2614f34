"""What all training photos look like to a trained method: the mean light, and which photo is most alike."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from wildgs.light.photos import encode_view
from wildgs.model.appearance import Embeddings
from wildgs.model.method import Method
from wildgs.scene import View

MAX_PHOTOS = 200
"""Photos that are looked at; of larger collections as many, evenly spread over the names."""

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Atlas:
    """The light of the training photos.

    Attributes:
        views: The photos.
        global_embeddings: Emb^g of each.
        mean: Mean of all embeddings and colour maps over the photos: the neutral light.
    """

    views: tuple[View, ...]
    global_embeddings: Float[Tensor, "V G"]
    mean: Embeddings

    def most_alike(self, global_embedding: Float[Tensor, " G"]) -> View:
        """The photo whose global embedding is nearest."""
        distance = (self.global_embeddings - global_embedding).norm(dim=1)
        return self.views[int(distance.argmin())]


@torch.no_grad()
def make_atlas(method: Method, views: Sequence[View], progress: Progress | None = None) -> Atlas:
    """Encodes the training photos, `MAX_PHOTOS` at most.

    Args:
        method: The trained method.
        views: Training views, at least one.
        progress: Called with (photos encoded, photos in all).
    """
    count = min(len(views), MAX_PHOTOS)
    chosen = tuple(views[index * len(views) // count] for index in range(count))
    global_embeddings: list[Tensor] = []

    def encoded() -> Iterator[Embeddings]:
        for number, view in enumerate(chosen, start=1):
            embeddings = method.embed(encode_view(method, view))
            global_embeddings.append(embeddings.global_embedding)
            yield embeddings
            if progress is not None:
                progress(number, count)

    mean = method.mean(encoded(), count)
    return Atlas(chosen, torch.stack(global_embeddings), mean)
