"""Gaussians for export, as plain arrays that do not depend on the method."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from wildgs.geometry.rotation import rotations_to_quats
from wildgs.geometry.spherical_harmonics import rotate_sh, sh_degree
from wildgs.scene.scene import Alignment


@dataclass(frozen=True)
class Splats:
    """Gaussians under one appearance.

    Attributes:
        means: Centres, world units.
        quats: Orientations (w, x, y, z), not necessarily normalised.
        scales: Standard deviations along the principal axes, world units, linear.
        opacities: Opacities in [0, 1], linear.
        sh: Spherical harmonics, 1, 4, 9 or 16 coefficients per channel.
    """

    means: Float[Tensor, "N 3"]
    quats: Float[Tensor, "N 4"]
    scales: Float[Tensor, "N 3"]
    opacities: Float[Tensor, " N"]
    sh: Float[Tensor, "N K 3"]

    def __len__(self) -> int:
        return self.means.shape[0]

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics."""
        return sh_degree(self.sh)

    def select(self, keep: Bool[Tensor, " N"]) -> Splats:
        """The Gaussians that are True in `keep`."""
        return Splats(
            self.means[keep], self.quats[keep], self.scales[keep], self.opacities[keep], self.sh[keep]
        )

    def with_sh(self, sh: Float[Tensor, "N K 3"]) -> Splats:
        """The same Gaussians with other spherical harmonics."""
        return replace(self, sh=sh)

    def to_input_frame(self, alignment: Alignment) -> Splats:
        """The Gaussians in the frame of the input COLMAP model: its origin, axes and scale.

        Args:
            alignment: Transform from the frame of the input to that of the Gaussians.
        """
        back = alignment.inverse()
        rotated = self.rotated(back.rotation)
        return replace(rotated, means=back.apply_points(self.means), scales=self.scales * back.scale)

    def rotated(self, rotation: Float[Tensor, "3 3"]) -> Splats:
        """The Gaussians after a rotation of the world about its origin, including their harmonics."""
        turn = rotations_to_quats(rotation[None]).to(self.quats)
        return Splats(
            means=self.means @ rotation.to(self.means).T,
            quats=_multiply(turn, torch.nn.functional.normalize(self.quats, dim=1)),
            scales=self.scales,
            opacities=self.opacities,
            sh=rotate_sh(self.sh, rotation),
        )


def _multiply(first: Float[Tensor, "_ 4"], second: Float[Tensor, "N 4"]) -> Float[Tensor, "N 4"]:
    """Hamilton product of quaternions (w, x, y, z): `second` rotated by `first`."""
    a, v = first[:, :1], first[:, 1:].expand(len(second), 3)
    b, u = second[:, :1], second[:, 1:]
    real = a * b - (v * u).sum(dim=1, keepdim=True)
    return torch.cat([real, a * u + b * v + torch.linalg.cross(v, u)], dim=1)
