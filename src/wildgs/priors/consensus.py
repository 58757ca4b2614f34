"""How well other photos agree with each place of a photo, whatever has been trained.

A passer-by is in one photo only, whereas trees, statues and arches are in all photos of the place, under other
light and perhaps with other leaves. Features of a pretrained network depend little on light. They are compared by
a plane sweep: every cell of a photo is projected into the neighbouring photos at many depths, and its consensus is
the similarity that a fifth of them reaches at the best depth.

The sweep needs cameras but no trained scene. What a mask hides is not learnt, hence differs from its render and
stays hidden, so that a render cannot tell trees that have not been learnt from passers-by.

Plane sweeps: Collins 1996. Comparing features of pretrained networks instead of colours: Zhang et al. 2018 (LPIPS).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from wildgs.geometry.camera import Camera

NEIGHBOURS = 24
"""Upper bound on the number of photos with which each photo is compared."""
DEPTHS = 64
"""Number of depths, equally spaced in inverse depth."""
FARTHEST = 1e-4
"""Inverse of the largest depth, as a share of the largest inverse depth."""
NEAR_QUANTILE, NEAR_SHARE = 0.02, 0.6
"""The nearest depth is this share of this quantile of the depths of the scene's points."""
AGREEING = 0.2
"""Share of the photos that have to show the same. In the others, something else may be in front of it."""
LEAST_PHOTOS = 3
"""Number of photos that have to show a place at some depth; else there is no consensus about it."""
COMPONENTS = 48
"""Number of principal components to which features are reduced."""
TRANSIENT, STATIC = 0.45, 0.75
"""Consensus up to which a cell may be transient, and from which it is static, as shares of the median over the
collection."""


@torch.no_grad()
def principal_directions(features: Sequence[Float[Tensor, "C _ _"]]) -> Float[Tensor, "C D"]:
    """Directions of the largest variance of features around zero, at most `COMPONENTS`."""
    columns = [each.flatten(1).double() for each in features]
    covariance = torch.stack([each @ each.T for each in columns]).sum(dim=0)
    return torch.linalg.eigh(covariance).eigenvectors[:, -COMPONENTS:].to(features[0])


@torch.no_grad()
def reduced(features: Float[Tensor, "C h w"], directions: Float[Tensor, "C D"]) -> Float[Tensor, "D h w"]:
    """Features along the directions, as unit vectors."""
    return functional.normalize(torch.einsum("chw,cd->dhw", features, directions), dim=0)


def nearest_depth(camera: Camera, points: Float[Tensor, "P 3"]) -> float | None:
    """The nearest depth of the sweep; None if the camera has no points in front of it.

    Args:
        camera: The camera.
        points: The scene's points, world units.
    """
    depths = (points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3])[:, 2]
    depths = depths[depths > 0]
    return NEAR_SHARE * float(depths.double().quantile(NEAR_QUANTILE)) if len(depths) else None


@torch.no_grad()
def consensus(
    features: Float[Tensor, "D h w"],
    camera: Camera,
    others: Sequence[tuple[Float[Tensor, "D _ _"], Camera]],
    nearest: float,
) -> Float[Tensor, "h w"]:
    """Consensus of other photos with each cell of a photo.

    Args:
        features: Unit vectors of the photo, cell by cell.
        camera: The photo's camera; its image is covered by the cells.
        others: Features and cameras of the other photos.
        nearest: Depth of the nearest plane, world units.

    Returns:
        Cosine similarity, -1 to 1; NaN where too few other photos show the place at any depth.
    """
    height, width = features.shape[1:]
    unknown = features.new_full((height, width), torch.nan)
    if len(others) < LEAST_PHOTOS:
        return unknown
    places = _swept(camera, height, width, nearest)
    found = torch.stack([_similarity(features, places, *other) for other in others])
    seen = (~found.isnan()).sum(dim=0)
    # The value that a share of the photos which show the place reaches; -2 where a photo does not show it.
    ordered = found.nan_to_num(-2.0).sort(dim=0, descending=True).values
    rank = (AGREEING * (seen - 1).clamp_min(0)).round().long()
    reached = ordered.gather(0, rank[None])[0]
    best = torch.where(seen >= LEAST_PHOTOS, reached, -2.0).amax(dim=1).view(height, width)
    return torch.where(best < -1.5, unknown, best)


def _swept(camera: Camera, height: int, width: int, nearest: float) -> Float[Tensor, "P L 3"]:
    """World positions of the centres of all cells at all depths."""
    device = camera.K.device
    inverse = torch.linspace(0, 1, DEPTHS, device=device).clamp_min(FARTHEST) / nearest
    y, x = torch.meshgrid(
        (torch.arange(height, device=device) + 0.5) * camera.height / height,
        (torch.arange(width, device=device) + 0.5) * camera.width / width,
        indexing="ij",
    )
    K = camera.K
    rays = torch.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], torch.ones_like(x)], dim=-1)
    local = rays.view(-1, 1, 3) / inverse[:, None]
    return (local - camera.viewmat[:3, 3]) @ camera.viewmat[:3, :3]


def _similarity(
    features: Float[Tensor, "D h w"],
    places: Float[Tensor, "P L 3"],
    other: Float[Tensor, "D _ _"],
    camera: Camera,
) -> Float[Tensor, "P L"]:
    """Cosine similarity of each cell with what another photo shows at its places; NaN outside of that photo."""
    local = places @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    depth = local[..., 2]
    pixels = local[..., :2] / depth.clamp_min(1e-9)[..., None]
    K, size = camera.K, torch.tensor([camera.width, camera.height], device=camera.K.device)
    grid = 2 * (pixels * torch.stack([K[0, 0], K[1, 1]]) + K[:2, 2]) / size - 1
    inside = (depth > 0) & (grid.abs() < 1).all(dim=-1)
    shown = functional.grid_sample(
        other[None], grid.clamp(-2, 2)[None], padding_mode="border", align_corners=False
    )[0]
    similarity = (features.flatten(1)[:, :, None] * shown).sum(dim=0) / shown.norm(dim=0).clamp_min(1e-6)
    return torch.where(inside, similarity, torch.nan)


@torch.no_grad()
def doubts(found: Sequence[Float[Tensor, "_ _"]]) -> list[Float[Tensor, "_ _"]]:
    """Degree to which each cell may be transient, given the consensus in all photos of a collection.

    Similarities depend on how different the photos are, so that they are compared with their median.

    Args:
        found: From `consensus`, one per photo.

    Returns:
        1 up to `TRANSIENT` medians, 0 from `STATIC` medians on, linear in between; 1 where there is no consensus.
    """
    known = torch.cat([each.flatten() for each in found]) if found else torch.zeros(0)
    known = known[~known.isnan()]
    if not len(known):
        return [torch.ones_like(each) for each in found]
    median = known.median().clamp_min(1e-3)
    return [((STATIC - each / median) / (STATIC - TRANSIENT)).clamp(0, 1).nan_to_num(1.0) for each in found]
