"""Gaussians as the browser draws them: centres, covariances, one colour and one opacity each."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from wildgs.geometry.camera import Camera
from wildgs.geometry.rotation import quats_to_rotations
from wildgs.model.gaussians import Gaussians
from wildgs.rasterize import sh_to_colors
from wildgs.rasterize.interface import MIN_ALPHA

ENLARGED = 10.0
"""Covariances go to the browser in half precision, whose numbers are coarse below 6e-5. The aligned frame's unit is
the photos' usual depth, and a Gaussian as wide as a pixel there has a variance of 1e-6. Splats are handed over this
much larger, and their scene node shrinks them again."""

_HALF_MAX = 6e4


@dataclass(frozen=True)
class Splats:
    """Geometry as viser takes it, enlarged by `ENLARGED`.

    Attributes:
        rows: Which Gaussians these are; those that no picture shows are left out.
        means: Their centres in the aligned frame, for colours that depend on the direction; on the method's device.
        centers: The same, enlarged.
        covariances: World axes, enlarged.
        opacities: In [0, 1].
    """

    rows: Int[Tensor, " M"]
    means: Float[Tensor, "M 3"]
    centers: Float[np.ndarray, "M 3"]
    covariances: Float[np.ndarray, "M 3 3"]
    opacities: Float[np.ndarray, "M 1"]

    def __len__(self) -> int:
        return len(self.rows)


@torch.no_grad()
def splats_of(gaussians: Gaussians) -> Splats:
    """Packs all Gaussians that can be seen: finite, and with an opacity of at least 1/255 as in the rasteriser."""
    scales, opacities = gaussians.scales, gaussians.opacities
    finite = gaussians.means.isfinite().all(dim=1) & scales.isfinite().all(dim=1)
    finite &= gaussians.quats.isfinite().all(dim=1)
    rows = (finite & (opacities >= MIN_ALPHA)).nonzero()[:, 0]
    means = gaussians.means[rows].detach().clone()
    axes = quats_to_rotations(gaussians.quats[rows]) * (scales[rows] * ENLARGED)[:, None, :]
    covariances = (axes @ axes.transpose(1, 2)).clamp(-_HALF_MAX, _HALF_MAX)
    return Splats(
        rows=rows,
        means=means,
        centers=(means * ENLARGED).cpu().numpy(),
        covariances=covariances.cpu().numpy(),
        opacities=opacities[rows, None].cpu().numpy(),
    )


@torch.no_grad()
def colors_from(
    means: Float[Tensor, "M 3"], sh: Float[Tensor, "M K 3"], position: Float[Tensor, " 3"], degree: int
) -> Float[np.ndarray, "M 3"]:
    """Colours in [0, 1] as seen from a place: exact there, whatever way one looks.

    Args:
        means: Centres.
        sh: Spherical harmonics.
        position: The eye, in the same frame as the centres.
        degree: Of the harmonics to use.
    """
    return sh_to_colors(means, sh, _eye_at(position.to(means)), degree=degree).clamp(0, 1).cpu().numpy()


@torch.no_grad()
def distances_from(means: Float[Tensor, "M 3"], position: Float[Tensor, " 3"]) -> Float[np.ndarray, " M"]:
    """How far the centres are from a place, world units."""
    return (means - position.to(means)).norm(dim=1).cpu().numpy()


def _eye_at(position: Float[Tensor, " 3"]) -> Camera:
    viewmat = torch.eye(4).to(position)
    viewmat[:3, 3] = -position
    return Camera(viewmat, torch.eye(3).to(position), 1, 1)


def as_viser(splats: Splats, colors: Float[np.ndarray, "M 3"]) -> dict[str, Any]:
    """Arguments for viser's `add_gaussian_splats` and `set_gaussians`."""
    return {
        "centers": splats.centers,
        "covariances": splats.covariances,
        "rgbs": colors,
        "opacities": splats.opacities,
    }
