"""Gaussians for export, independent of the method: transforming and cleaning them, and measuring the loss."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation
from torch import Tensor

from wildgs.errors import UserError
from wildgs.exporters.config import CleanupConfig
from wildgs.geometry.camera import Camera
from wildgs.geometry.spherical_harmonics import (
    fit_truncation,
    num_sh_bases,
    rotate_sh,
    sh_degree,
    truncate_sh,
)
from wildgs.model.gaussians import NEAR
from wildgs.model.triplane import robust_box
from wildgs.rasterize import rasterize
from wildgs.scene.scene import Alignment


@dataclass(frozen=True)
class Splats:
    """Gaussians under one appearance.

    Attributes:
        means: Centres.
        quats: Orientations (w, x, y, z), not necessarily normalised.
        scales: Standard deviations along the principal axes.
        opacities: Opacities in [0, 1].
        sh: Spherical harmonics, 1, 4, 9 or 16 coefficients per channel.
        sky: Mask of the sky Gaussians; None if the method does not know them.
    """

    means: Float[Tensor, "N 3"]
    quats: Float[Tensor, "N 4"]
    scales: Float[Tensor, "N 3"]
    opacities: Float[Tensor, " N"]
    sh: Float[Tensor, "N K 3"]
    sky: Bool[Tensor, " N"] | None = None

    def __len__(self) -> int:
        return self.means.shape[0]

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics."""
        return sh_degree(self.sh)

    def select(self, keep: Bool[Tensor, " N"]) -> Splats:
        """The Gaussians that are True in `keep`."""
        present = {name: value for name, value in vars(self).items() if value is not None}
        return Splats(**{name: value[keep] for name, value in present.items()})

    def with_sh(self, sh: Float[Tensor, "N K 3"]) -> Splats:
        """The same Gaussians with other spherical harmonics."""
        return replace(self, sh=sh)

    def to_input_frame(self, alignment: Alignment) -> Splats:
        """The Gaussians in the frame of the COLMAP model."""
        return self.moved(alignment.inverse())

    def moved(self, motion: Alignment) -> Splats:
        """The Gaussians after a rotation, a change of scale and a translation of the world."""
        rotated = self.rotated(motion.rotation)
        return replace(rotated, means=motion.apply_points(self.means), scales=self.scales * motion.scale)

    def rotated(self, rotation: Float[Tensor, "3 3"]) -> Splats:
        """The Gaussians after a rotation of the world about its origin, including their harmonics."""
        turn = Rotation.from_matrix(rotation.double().cpu().numpy())
        turned = (turn * Rotation.from_quat(self.quats.double().cpu().numpy(), scalar_first=True)).as_quat(
            scalar_first=True
        )
        return replace(
            self,
            means=self.means @ rotation.to(self.means).T,
            quats=torch.from_numpy(turned).to(self.quats),
            sh=rotate_sh(self.sh, rotation),
        )


BOX_QUANTILE = 0.02
"""Fraction of the SfM points outside the crop box, at each end of each axis."""


def kept_rows(config: CleanupConfig, splats: Splats, points: Float[Tensor, "P 3"]) -> Bool[Tensor, " N"]:
    """Mask of the Gaussians (aligned frame) to keep; `points` are the SfM points in the same frame.

    Raises:
        UserError: The sky is to be dropped, but the method does not know which Gaussians it consists of.
    """
    keep = splats.opacities >= config.min_opacity
    if config.max_distance is not None:
        middle = points.median(dim=0).values.to(splats.means)
        keep &= (splats.means - middle).norm(dim=1) <= config.max_distance
    if config.crop is not None:
        box = robust_box(points, BOX_QUANTILE, config.crop)
        low, high = box.low.to(splats.means), box.high.to(splats.means)
        keep &= ((splats.means >= low) & (splats.means <= high)).all(dim=1)
    if config.drop_sky:
        if splats.sky is None:
            raise UserError("--drop-sky: this run's method does not know which Gaussians are sky; use --crop")
        keep &= ~splats.sky
    return keep


def clean(
    config: CleanupConfig,
    splats: Splats,
    points: Float[Tensor, "P 3"],
    viewpoints: Float[Tensor, "V 3"],
) -> Splats:
    """Drops Gaussians and truncates harmonics as configured; everything is in the aligned frame.

    Truncated harmonics are fitted to the directions from the camera centres `viewpoints`.
    """
    kept = splats.select(kept_rows(config, splats, points)) if config.active else splats
    if config.sh_degree is None or num_sh_bases(config.sh_degree) >= kept.sh.shape[1]:
        return kept
    fit = (
        fit_truncation(kept.means, viewpoints, kept.sh_degree, config.sh_degree) if len(viewpoints) else None
    )
    return kept.with_sh(truncate_sh(kept.sh, config.sh_degree, fit))


def agreement(first: Splats, second: Splats, cameras: Sequence[Camera]) -> float:
    """PSNR in dB between the renders of two sets of Gaussians, pooled over all cameras; infinite if equal."""
    errors = []
    for camera in cameras:
        one, other = (_picture(splats, camera) for splats in (first, second))
        errors.append((one - other).square().mean())
    return float(-10 * torch.log10(torch.stack(errors).mean()))


@torch.no_grad()
def _picture(splats: Splats, camera: Camera) -> Float[Tensor, "H W 3"]:
    """Render, rounded to 8 bits."""
    rendering = rasterize(
        splats.means, splats.quats, splats.scales, splats.opacities, splats.sh.contiguous(), camera,
        sh_degree=splats.sh_degree, near=NEAR, depth=False,
    )  # fmt: skip
    return (rendering.colors.double().clamp(0, 1) * 255).round() / 255
