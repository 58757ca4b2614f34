"""Several lights in one file: shared harmonics, metadata, and the frame with +y up."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from PIL import Image
from torch import Tensor

from wildgs.exporters.splats import Splats
from wildgs.geometry.camera import Camera
from wildgs.geometry.spherical_harmonics import sh_basis
from wildgs.scene.scene import Alignment

Y_UP = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]], dtype=torch.float64)
"""Rotation from the aligned frame (+z up) to that of glTF and most USD files (+y up)."""


@dataclass(frozen=True)
class ExportLight:
    """One light of a file.

    Attributes:
        name: Name of the photo or image.
        sh: Spherical harmonics of all Gaussians.
        thumbnail: Image of any size, which is cropped and reduced.
        captured: Local capture time of the photo, ISO 8601; None if unknown.
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
        splats: Geometry; its harmonics are ignored.
        lights: At least one light.
        start: Camera of the initial view, in the same frame.
        near: Near plane, in units of the file's frame.
        placement: Transform from the file's frame to that of the COLMAP model.
    """

    title: str
    splats: Splats
    lights: Sequence[ExportLight]
    start: Camera
    near: float
    placement: Alignment


def upright(alignment: Alignment, *, aligned: bool) -> Alignment:
    """The transform from the aligned frame to a file's frame with +y up.

    Args:
        alignment: Transform from the COLMAP model's frame to the aligned frame.
        aligned: Keep origin and scale of the aligned frame instead of those of the COLMAP model.
    """
    if aligned:
        return Alignment(Y_UP, torch.zeros(3, dtype=torch.float64))
    back = alignment.inverse()
    return Alignment(Y_UP, Y_UP @ back.rotation.T @ back.translation, back.scale)


@dataclass(frozen=True)
class SharedHarmonics:
    """Harmonics of several lights that share the higher degrees of most Gaussians.

    Attributes:
        rest: Higher degrees shared by all lights.
        base: Degree 0 of each light.
        rows: For each light, ascending indices of the Gaussians with separate higher degrees.
        own: For each light, the higher degrees of these Gaussians.
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
    """Shares the higher degrees of most Gaussians among all lights.

    The shared degrees are the mean over the lights. Degree 0 of each light absorbs the difference, averaged over
    the directions from the cameras. The Gaussians for which this changes the images most keep separate higher
    degrees.

    Args:
        splats: Geometry.
        lights: Harmonics of each light.
        viewpoints: Camera centres in the same frame.
        own_share: Fraction of the Gaussians with separate higher degrees for each light.
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
    """Mean of the SH basis over the directions from the cameras, and covariance of its higher degrees."""
    means, spreads = [], []
    for part in splats.means.split(chunk):
        towards = torch.nn.functional.normalize(part[:, None] - viewpoints.to(part), dim=-1)
        basis = sh_basis(degree, towards)
        means.append(basis.mean(dim=1))
        away = (basis - means[-1][:, None])[..., 1:]
        spreads.append(away.transpose(1, 2) @ away / away.shape[1])
    return torch.cat(means), torch.cat(spreads)


_MOST_AREA = 0.05
"""Upper bound of a Gaussian's area in the image, relative to the squared focal length."""


def _picture_area(splats: Splats, viewpoints: Float[Tensor, "V 3"]) -> Float[Tensor, " N"]:
    """Approximate image area of each Gaussian: product of its two longer axes over its squared distance."""
    distance = torch.cdist(splats.means, viewpoints.to(splats.means)).median(dim=1).values.clamp_min(1e-6)
    longest = splats.scales.sort(dim=1, descending=True).values
    return (longest[:, 0] * longest[:, 1] / distance.square()).clamp_max(_MOST_AREA)


THUMBNAIL = (288, 192)
_QUALITY = 82


def thumbnail_url(pixels: UInt8[np.ndarray, "H W 3"]) -> str:
    """Centre crop of an image as a data URL."""
    image = Image.fromarray(np.ascontiguousarray(pixels))
    wide, tall = THUMBNAIL
    scale = max(wide / image.width, tall / image.height)
    left, top = (image.width - wide / scale) / 2, (image.height - tall / scale) / 2
    box = (max(left, 0), max(top, 0), image.width - max(left, 0), image.height - max(top, 0))
    buffer = io.BytesIO()
    image.resize(THUMBNAIL, Image.Resampling.LANCZOS, box=box).save(buffer, "JPEG", quality=_QUALITY)
    return "data:image/jpeg;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")
