"""3D Wrapping (paper, figure 2 right): back-projection of pixels, the triplane, and local embeddings."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from wildgs.geometry.camera import Camera
from wildgs.model.config import WrappingConfig
from wildgs.model.gaussians import rows_to_shade
from wildgs.model.precision import MixedModule
from wildgs.model.triplane import PICTURE_CHANNELS, Box, project_cloud, sample_planes
from wildgs.model.unet import UNet, standardize_output

MIN_ALPHA = 0.5
"""Smallest accumulated alpha of a pixel for its rendered depth to be used."""


def liftable(
    visibility: Float[Tensor, "*pixels"] | None, alpha: Float[Tensor, "*pixels"], threshold: float
) -> Bool[Tensor, "*pixels"]:
    """Pixels that may be lifted: static (M > Th) and covered by Gaussians."""
    covered = alpha > MIN_ALPHA
    return covered if visibility is None else covered & (visibility > threshold)


def random_part(height: int, width: int, device: torch.device | str = "cpu") -> Bool[Tensor, "H W"]:
    """A mask of one side of a random vertical or horizontal cut through the middle half of an image."""
    place, upright, kept_first = torch.rand(3).tolist()
    length = width if upright < 0.5 else height
    first = torch.arange(length, device=device) < round((0.25 + 0.5 * place) * length)
    chosen = first if kept_first < 0.5 else ~first
    return (chosen[None, :] if upright < 0.5 else chosen[:, None]).expand(height, width)


@torch.no_grad()
def lift(
    photo: Float[Tensor, "H W 3"], depth: Float[Tensor, "H W"], camera: Camera
) -> tuple[Float[Tensor, "P 3"], Float[Tensor, "P 3"]]:
    """Back-projection BP: all pixels as world points P and their colours C, in row-major order.

    Args:
        photo: RGB in [0, 1].
        depth: Expected depth along the camera's z axis, world units.
        camera: The photo's camera.
    """
    return camera.unproject(depth).reshape(-1, 3), photo.reshape(-1, 3)


class Wrapping(MixedModule):
    """Coloured cloud -> six projections -> U^3D -> Emb^l per point; the learnable v outside the box."""

    low: Tensor
    high: Tensor

    def __init__(self, config: WrappingConfig, box: Box, *, reverse: bool = True) -> None:
        """Creates the networks.

        Args:
            config: Configuration.
            box: Bounding box of the triplane.
            reverse: Whether to use the reverse projections c' (False: ablation 'w/o {c'}').
        """
        super().__init__()
        self.config = config
        self.reverse = reverse
        self.register_buffer("low", box.low.clone())
        self.register_buffer("high", box.high.clone())
        directions = 2 if reverse else 1
        self.unet = UNet(PICTURE_CHANNELS * directions, config.widths, config.features)
        self.local_mlp = nn.Sequential(
            nn.Linear(config.features, 32), nn.ReLU(inplace=True), nn.Linear(32, config.local_size)
        )
        self.outside = nn.Parameter(torch.zeros(config.local_size))

    @property
    def box(self) -> Box:
        """The bounding box of the triplane."""
        return Box(self.low, self.high)

    def planes(
        self,
        points: Float[Tensor, "P 3"],
        colors: Float[Tensor, "P 3"],
        keep: Bool[Tensor, " P"] | None = None,
        *,
        learn: bool = True,
    ) -> Float[Tensor, "3 C R R"]:
        """F^T: feature maps of XY, YZ and ZX from a coloured cloud in world coordinates; see `project_cloud`.

        `learn` is whether U^3D gets gradients.
        """
        pictures = project_cloud(self.box.normalize(points), colors, self.config.resolution, keep)
        if not self.reverse:
            pictures = pictures[:, :1]
        # CUDA graphs are captured with gradients only; replaying one costs nothing without a backward pass.
        with torch.set_grad_enabled(torch.is_grad_enabled() and (learn or self.replays.records(pictures))):
            (planes,) = self.replays(self._networks, (self.unet,), pictures.flatten(1, 2))
        return planes if learn else planes.detach()

    def _networks(self, pictures: Float[Tensor, "3 I R R"]) -> tuple[Float[Tensor, "3 C R R"]]:
        with self.mixed(pictures.device):
            return (self.unet(pictures).float(),)

    @torch.no_grad()
    def calibrate(self, points: Float[Tensor, "P 3"], colors: Float[Tensor, "P 3"]) -> None:
        """Scales initial local embeddings to mean 0 and variance 1 over a coloured cloud.

        Args:
            points: SfM points, world coordinates.
            colors: RGB in [0, 1].
        """
        inside = self.box.contains(points)
        if int(inside.sum()) > 1:
            sampled = sample_planes(self.planes(points, colors), self.box.normalize(points[inside]))
            last = self.local_mlp[-1]
            assert isinstance(last, nn.Linear)
            standardize_output(last, self.local_mlp(sampled))

    def local_embeddings(
        self, planes: Float[Tensor, "3 C R R"] | None, means: Float[Tensor, "N 3"]
    ) -> Float[Tensor, "N L"]:
        """Emb^l of every Gaussian: sampled from the planes inside the box, v outside or without planes.

        The centres get no gradient, so that the appearance of single photos does not affect the geometry.
        """
        everywhere = self.outside.expand(len(means), -1)
        if planes is None:
            return everywhere
        means = means.detach()
        inside = self.box.contains(means)
        # About half of the visible Gaussians are outside.
        rows = rows_to_shade(inside)
        sampled = sample_planes(planes, self.box.normalize(means[rows]))
        with self.mixed(means.device):
            local = self.local_mlp(sampled)
        local = torch.where(inside[rows, None], local, self.outside.to(local.dtype))
        return everywhere.to(local.dtype).index_copy(0, rows, local)
