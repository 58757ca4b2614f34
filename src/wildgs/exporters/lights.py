"""The lights of one file: harmonics that they share, what identifies each, and the frame that viewers expect."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from wildgs.exporters.splats import Splats
from wildgs.geometry.camera import Camera
from wildgs.geometry.spherical_harmonics import sh_basis
from wildgs.scene.scene import Alignment

Y_UP = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]], dtype=torch.float64)
"""From the aligned frame (+z up) to that of glTF and most of USD (+y up)."""


@dataclass(frozen=True)
class ExportLight:
    """One light of a file.

    Attributes:
        name: The photo's or picture's name.
        sh: Spherical harmonics of all Gaussians.
        thumbnail: Picture of any size, from which a small one is cut.
        captured: Local time at which the photo was taken, ISO 8601; None where it is not known.
    """

    name: str
    sh: Float[Tensor, "N K 3"]
    thumbnail: UInt8[np.ndarray, "_ _ 3"]
    captured: str | None = None


@dataclass(frozen=True)
class RelightableScene:
    """Gaussians under several lights, in the frame of the file (+y up).

    Attributes:
        title: Name of the scene.
        splats: Geometry; its own harmonics are ignored.
        lights: At least one.
        start: Camera of the initial view, in the same frame.
        near: Near plane, world units.
        placement: From the file's frame to that of the input COLMAP model.
    """

    title: str
    splats: Splats
    lights: Sequence[ExportLight]
    start: Camera
    near: float
    placement: Alignment


def upright(alignment: Alignment, *, aligned: bool) -> Alignment:
    """From the aligned frame to a file's with +y up.

    Args:
        alignment: From the input's frame to the aligned one.
        aligned: Keep origin and scale of the aligned frame, instead of those of the input.
    """
    if aligned:
        return Alignment(Y_UP, torch.zeros(3, dtype=torch.float64))
    back = alignment.inverse()
    return Alignment(Y_UP, Y_UP @ back.rotation.T @ back.translation, back.scale)


@dataclass(frozen=True)
class SharedHarmonics:
    """Harmonics of several lights, of which only the degree 0 and some Gaussians' higher degrees are apart.

    Attributes:
        rest: Higher degrees that all lights share.
        base: Degree 0 of each light.
        rows: Gaussians that have higher degrees of their own, ascending, for each light.
        own: Their higher degrees.
    """

    rest: Float[Tensor, "N M 3"]
    base: tuple[Float[Tensor, "N 3"], ...]
    rows: tuple[Int[Tensor, " _"], ...]
    own: tuple[Float[Tensor, "_ M 3"], ...]

    @property
    def all_own(self) -> bool:
        """Whether nothing is shared."""
        return all(len(rows) == len(self.rest) for rows in self.rows)

    def whole(self, light: int) -> Float[Tensor, "N K 3"]:
        """All harmonics of one light."""
        rest = self.rest.index_copy(0, self.rows[light], self.own[light])
        return torch.cat([self.base[light][:, None], rest], dim=1)


def share_harmonics(
    splats: Splats,
    lights: Sequence[Float[Tensor, "N K 3"]],
    viewpoints: Float[Tensor, "V 3"],
    own_share: float,
) -> SharedHarmonics:
    """Gives most Gaussians the same higher degrees under all lights.

    The shared degrees are the mean over the lights. Degree 0 of each light takes up the difference, averaged over
    the directions from the cameras. The Gaussians for which this changes the pictures most keep their own.

    Args:
        splats: Geometry.
        lights: Harmonics of each light.
        viewpoints: Camera centres in the same frame.
        own_share: Share of the Gaussians that keep their own higher degrees in each light.
    """
    stack = torch.stack(list(lights))
    count, bases = stack.shape[1:3]
    rest = stack[:, :, 1:].mean(dim=0)
    if bases == 1 or len(lights) == 1 or own_share >= 1 or not len(viewpoints):
        rows = (torch.arange(count),) * len(lights)
        return SharedHarmonics(
            rest, tuple(light[:, 0] for light in lights), rows, tuple(light[:, 1:] for light in lights)
        )
    mean, spread = _directions(splats, viewpoints, int(bases**0.5) - 1)
    weight = _picture_area(splats, viewpoints) * splats.opacities
    base, rows, own = [], [], []
    for light in lights:
        change = light[:, 1:] - rest
        error = torch.einsum("nic,nij,njc->n", change, spread, change) * weight
        chosen = error.topk(round(own_share * count)).indices.sort().values
        shift = torch.einsum("nic,ni->nc", change, mean[:, 1:]) / mean[:, :1]
        shift[chosen] = 0.0
        base.append(light[:, 0] + shift)
        rows.append(chosen)
        own.append(light[chosen, 1:])
    return SharedHarmonics(rest, tuple(base), tuple(rows), tuple(own))


def _directions(
    splats: Splats, viewpoints: Float[Tensor, "V 3"], degree: int, chunk: int = 8192
) -> tuple[Float[Tensor, "N K"], Float[Tensor, "N M M"]]:
    """Mean of the basis over the directions from the cameras, and covariance of its higher degrees."""
    means, spreads = [], []
    for part in splats.means.split(chunk):
        towards = torch.nn.functional.normalize(part[:, None] - viewpoints.to(part), dim=-1)
        basis = sh_basis(degree, towards)
        means.append(basis.mean(dim=1))
        away = (basis - means[-1][:, None])[..., 1:]
        spreads.append(away.transpose(1, 2) @ away / away.shape[1])
    return torch.cat(means), torch.cat(spreads)


_MOST_AREA = 0.05
"""Bound of a Gaussian's area in the pictures, relative to the squared focal length, for those at a camera."""


def _picture_area(splats: Splats, viewpoints: Float[Tensor, "V 3"]) -> Float[Tensor, " N"]:
    """Roughly how large each Gaussian is in the photos: product of its longer axes over its squared distance."""
    distance = torch.cdist(splats.means, viewpoints.to(splats.means)).median(dim=1).values.clamp_min(1e-6)
    longest = splats.scales.sort(dim=1, descending=True).values
    return (longest[:, 0] * longest[:, 1] / distance.square()).clamp_max(_MOST_AREA)
