"""The appearance of a photo, independent of the scene, and its embeddings for the Gaussians."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class Appearance:
    """The appearance of a photo, the result of `Method.encode`.

    Attributes:
        global_embedding: Emb^g; None for a method without appearance.
        planes: Triplane feature maps F^T; None: all Gaussians have the local embedding v.
        visibility: Mask M of the photo (1 = static); None for a method without a mask.
        color_map: Colour transform that corrects the embedding (`wildgs.model.color_match`), or None.
        basis_weights: Weights that correct both (`wildgs.model.light_basis`), or None.
        response: Response of the photo's camera (`wildgs.model.camera_response`), or None.
        sky_profile: The photo's sky by elevation (`wildgs.model.sky_profile`), or None.
    """

    global_embedding: Float[Tensor, " G"] | None = None
    planes: Float[Tensor, "3 C R R"] | None = None
    visibility: Float[Tensor, "H W"] | None = None
    color_map: Float[Tensor, "3 M"] | None = None
    basis_weights: Float[Tensor, " B"] | None = None
    response: Float[Tensor, " Q"] | None = None
    sky_profile: Float[Tensor, "3 9"] | None = None


@dataclass(frozen=True)
class Embeddings:
    """An appearance as embeddings of the Gaussians, for `Method.fuse` and for mixing.

    Attributes:
        global_embedding: Emb^g; empty for a method that is not relightable.
        local_embeddings: Emb^l per Gaussian; None for a method without local appearance.
        color_map: Colour transform [A | b] of all Gaussians, ``c + A c + b``, possibly with further columns for
            light codes and the sky (`wildgs.model.color_match.match_photo`), or None.
        basis_weights: Weights of the components of `wildgs.model.light_basis`, or None.
        response: Response of the camera, applied to pixels, not to Gaussians (`wildgs.model.camera_response`); None
            is the identity.
        sky_profile: Colours of the sky in directions that the photo does not show (`wildgs.model.sky_profile`), or
            None.
    """

    global_embedding: Float[Tensor, " G"]
    local_embeddings: Float[Tensor, "N L"] | None = None
    color_map: Float[Tensor, "3 M"] | None = None
    basis_weights: Float[Tensor, " B"] | None = None
    response: Float[Tensor, " Q"] | None = None
    sky_profile: Float[Tensor, "3 9"] | None = None


def blend_embeddings(
    parts: Sequence[Embeddings], weights: Sequence[float], local_weights: Sequence[float] | None = None
) -> Embeddings:
    """Appearance tuning: Σ w_k f_k on embeddings (paper, appendix Video Demo: two photos, 1 - α and α).

    Colour maps, basis weights and camera responses are mixed like global embeddings, and the sky profiles of the
    parts that have one by their share of the weights.

    Args:
        parts: Embeddings for the same Gaussians, at least one.
        weights: One weight per part.
        local_weights: Weights of the local embeddings; None takes `weights`.
    """
    local_weights = weights if local_weights is None else local_weights
    local = [part.local_embeddings for part in parts if part.local_embeddings is not None]
    return Embeddings(
        _weighted([part.global_embedding for part in parts], weights),
        _weighted(local, local_weights) if local else None,
        _mixed([part.color_map for part in parts], weights),
        _mixed([part.basis_weights for part in parts], weights),
        _mixed([part.response for part in parts], weights),
        _mixed_profiles([part.sky_profile for part in parts], weights),
    )


def mean_embeddings(parts: Iterable[Embeddings], count: int) -> Embeddings:
    """The mean of `count` embeddings, of which only one is in memory at a time.

    Colour maps, basis weights and sky profiles are averaged over the parts that have them. The mean has no camera
    response.
    """
    total_global, maps, basis, skies, local_mean = [], [], [], [], None
    for part in parts:
        total_global.append(part.global_embedding)
        if part.color_map is not None:
            maps.append(part.color_map)
        if part.basis_weights is not None:
            basis.append(part.basis_weights)
        if part.sky_profile is not None:
            skies.append(part.sky_profile)
        if part.local_embeddings is not None:
            local = part.local_embeddings / count
            local_mean = local if local_mean is None else local_mean.add_(local)
    means = [torch.stack(found).mean(dim=0) if found else None for found in (maps, basis, skies)]
    color_map, weights, sky_profile = means
    return Embeddings(
        torch.stack(total_global).mean(dim=0), local_mean, color_map, weights, sky_profile=sky_profile
    )


def _mixed(values: Sequence[Tensor | None], weights: Sequence[float]) -> Tensor | None:
    """Σ w x, with zero for parts without a value."""
    present = [value for value in values if value is not None]
    if not present:
        return None
    return _weighted([torch.zeros_like(present[0]) if x is None else x for x in values], weights)


def _mixed_profiles(values: Sequence[Tensor | None], weights: Sequence[float]) -> Tensor | None:
    """Σ w x / Σ w over the parts that have a value: no sky is not a black one."""
    present = [(value, weight) for value, weight in zip(values, weights, strict=True) if value is not None]
    total = sum(weight for _, weight in present)
    if total <= 0:
        return None
    return _weighted([value for value, _ in present], [weight / total for _, weight in present])


def _weighted(values: Sequence[Tensor], weights: Sequence[float]) -> Tensor:
    """Σ w x, ignoring values of weight 0 (even if they are non-finite)."""
    chosen = [(value, weight) for value, weight in zip(values, weights, strict=True) if weight != 0]
    total = chosen[0][0] * chosen[0][1]
    for value, weight in chosen[1:]:
        total = torch.add(total, value, alpha=weight)
    return total
