"""What all training photos look like to a trained method: the mean light, and which photo is most alike."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from wildgs.light.photos import encode_view
from wildgs.model.appearance import Embeddings
from wildgs.model.wildgs import WildGS
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
def make_atlas(method: WildGS, views: Sequence[View], progress: Progress | None = None) -> Atlas:
    """Encodes the training photos, `MAX_PHOTOS` at most.

    Args:
        method: The trained method.
        views: Training views, at least one.
        progress: Called with (photos encoded, photos in all).
    """
    count = min(len(views), MAX_PHOTOS)
    chosen = tuple(views[index * len(views) // count] for index in range(count))
    global_embeddings, color_maps, local_mean = [], [], None
    for number, view in enumerate(chosen, start=1):
        embeddings = method.embed(encode_view(method, view))
        global_embeddings.append(embeddings.global_embedding)
        if embeddings.color_map is not None:
            color_maps.append(embeddings.color_map)
        local = embeddings.local_embeddings / count
        local_mean = local if local_mean is None else local_mean.add_(local)
        if progress is not None:
            progress(number, count)
    assert local_mean is not None
    stacked = torch.stack(global_embeddings)
    color_map = torch.stack(color_maps).mean(dim=0) if color_maps else None
    return Atlas(chosen, stacked, Embeddings(stacked.mean(dim=0), local_mean, color_map))
