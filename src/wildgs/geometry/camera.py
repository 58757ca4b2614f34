"""Pinhole cameras in the OpenCV convention, and rotations by quaternions."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True)
class Camera:
    """A pinhole camera without distortion.

    Axes as in OpenCV and COLMAP: x right, y down, z forward. The centre of the top left pixel is (0.5, 0.5), and a
    point in front of the camera projects to ``K @ (x / z, y / z, 1)`` in pixels.

    Attributes:
        viewmat: World-to-camera rigid transform.
        K: Intrinsics in pixels.
        width: Image width in pixels.
        height: Image height in pixels.
    """

    viewmat: Float[Tensor, "4 4"]
    K: Float[Tensor, "3 3"]
    width: int
    height: int

    @property
    def position(self) -> Float[Tensor, "3"]:
        """Camera centre in world coordinates."""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]

    @property
    def forward(self) -> Float[Tensor, "3"]:
        """Viewing direction (unit length) in world coordinates."""
        return self.viewmat[2, :3]

    @property
    def up(self) -> Float[Tensor, "3"]:
        """Up direction of the image (unit length) in world coordinates."""
        return -self.viewmat[1, :3]

    def to(self, device: torch.device | str) -> Camera:
        """The same camera with its tensors on another device."""
        return replace(self, viewmat=self.viewmat.to(device), K=self.K.to(device))

    def resized(self, width: int, height: int) -> Camera:
        """The same view at another resolution; intrinsics are scaled per axis."""
        scale = torch.tensor([width / self.width, height / self.height, 1.0]).to(self.K)
        return replace(self, K=self.K * scale[:, None], width=width, height=height)

    def cropped(self, left: int, top: int, width: int, height: int) -> Camera:
        """The crop of the image that starts at pixel (left, top)."""
        K = self.K.clone()
        K[0, 2] -= left
        K[1, 2] -= top
        return replace(self, K=K, width=width, height=height)

    def centered(self) -> Camera:
        """The camera at the same place that looks through the centre of the image, its principal point.

        For programs that know no other principal point: photos are cropped, and theirs may be anywhere.
        """
        center = torch.tensor([self.width / 2, self.height / 2]).to(self.K)
        ahead = torch.cat(
            [(center - self.K[:2, 2]) / torch.stack([self.K[0, 0], self.K[1, 1]]), center.new_ones(1)]
        )
        ahead = torch.nn.functional.normalize(ahead, dim=0)
        # The smallest rotation of this direction to the z axis.
        x, y, z = ahead
        turn = torch.stack(
            [
                torch.stack([1 - x * x / (1 + z), -x * y / (1 + z), -x]),
                torch.stack([-x * y / (1 + z), 1 - y * y / (1 + z), -y]),
                ahead,
            ]
        )
        viewmat, K = self.viewmat.clone(), self.K.clone()
        viewmat[:3] = turn.to(viewmat) @ viewmat[:3]
        K[:2, 2] = center
        return replace(self, viewmat=viewmat, K=K)

    def project(self, points: Float[Tensor, "P 3"]) -> tuple[Float[Tensor, "P 2"], Float[Tensor, " P"]]:
        """Pixels (x, y) of world points, undefined where the depth is not positive, and depths along z."""
        seen = points @ self.viewmat[:3, :3].T + self.viewmat[:3, 3]
        pixels = seen @ self.K.T
        return pixels[:, :2] / pixels[:, 2:], seen[:, 2]

    def unproject(
        self,
        depth: Float[Tensor, "*pixels"],
        pixels: tuple[Int[Tensor, "*pixels"], Int[Tensor, "*pixels"]] | None = None,
    ) -> Float[Tensor, "*pixels 3"]:
        """World coordinates of pixel centres at depths along z (not along the ray), world units.

        Args:
            depth: Depths of the pixels.
            pixels: Rows and columns of the pixels; None for the whole image.
        """
        rays = self.pixel_rays(pixels)
        rotation, translation = self.viewmat[:3, :3], self.viewmat[:3, 3]
        return (rays * depth[..., None] - translation) @ rotation

    def pixel_rays(
        self, pixels: tuple[Int[Tensor, "*pixels"], Int[Tensor, "*pixels"]] | None = None
    ) -> Float[Tensor, "*pixels 3"]:
        """Camera-space rays through the pixel centres, scaled to z = 1; `pixels` as in `unproject`."""
        if pixels is None:
            sides = (torch.arange(side, device=self.K.device) for side in (self.height, self.width))
            y, x = torch.meshgrid(*sides, indexing="ij")
        else:
            y, x = pixels
        x = (x + 0.5 - self.K[0, 2]) / self.K[0, 0]
        y = (y + 0.5 - self.K[1, 2]) / self.K[1, 1]
        return torch.stack([x, y, torch.ones_like(x)], dim=-1)


def quats_to_rotations(quats: Float[Tensor, "N 4"]) -> Float[Tensor, "N 3 3"]:
    """Rotation matrices of quaternions (w, x, y, z), as in gsplat and COLMAP; they need not be normalised."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, dim=-1).reshape(-1, 3, 3)
