"""The light of a photo, apart from the scene it falls on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class Appearance:
    """What `encode` reads from a photo.

    Attributes:
        global_embedding: Emb^g, or None for a method without appearance.
        planes: Triplane feature maps F^T, or None: then every Gaussian's local embedding is the vector v.
        visibility: M of the encoded photo (1 = static), or None for a method without a mask.
    """

    global_embedding: Float[Tensor, " G"] | None = None
    planes: Float[Tensor, "3 C R R"] | None = None
    visibility: Float[Tensor, "H W"] | None = None


@dataclass(frozen=True)
class Embeddings:
    """Appearance carried to the Gaussians: what `fuse` takes and what tuning mixes.

    Attributes:
        global_embedding: Emb^g.
        local_embeddings: Emb^l per Gaussian.
    """

    global_embedding: Float[Tensor, " G"]
    local_embeddings: Float[Tensor, "N L"]


def mix(first: Embeddings, second: Embeddings, amount: float) -> Embeddings:
    """Tuning: (1 - a) f_1 + a f_2 on global and local embeddings (paper, appendix Video Demo).

    Args:
        first: Embeddings at amount 0.
        second: Embeddings at amount 1, for the same Gaussians.
        amount: a in [0, 1]; values outside extrapolate.
    """
    values: dict[str, Any] = {
        name: (1 - amount) * getattr(first, name) + amount * getattr(second, name)
        for name in ("global_embedding", "local_embeddings")
    }
    return Embeddings(**values)
