"""Estimates the direction of the sun in photos from shading and cast shadows.

For a grid of directions, shadow maps of the Gaussians predict which pixels of a photo the sun lights, and how
steeply. The direction whose prediction correlates best with the brightness of the photo, relative to the scene
under its mean light, is taken to be that of the sun. Exposure, white balance and contrast cancel out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import interpolate, normalize

from wildgs.geometry.camera import Camera
from wildgs.model.gaussians import Gaussians
from wildgs.rasterize import Rendering, rasterize

_ELEVATIONS, _AZIMUTHS = torch.arange(4.0, 88.0, 8.0), torch.arange(0.0, 360.0, 20.0)
SIDE = 240
"""Longest side of the images that are compared."""

_MAP, _PIXELS = 192, 3000
"""Side of a shadow map, and number of pixels that are compared."""

_DISTANCE = 30.0
"""Distance of the cameras of the shadow maps, in units of the scene's radius."""

_MARGIN = 1.3
"""Extent of a shadow map, in the same units."""

_BIAS, _BLUR = 0.03, 0.01
"""Depth behind a surface, in the same units, at which a point is half in shadow, and width of the transition."""

_AMBIENT, _GRAZING = 0.3, 0.3
"""Light of the sky relative to the sun's, and share of the sun's light that does not depend on its angle to the
surface (normals of Gaussians are imprecise)."""

_TEMPERATURE = 0.05
"""Difference in correlation that makes a direction e times as likely as another."""


class SunFinder:
    """Finds the direction of the sun in photos of one scene.

    Args:
        gaussians: The Gaussians in the aligned frame.
        sky: Mask of those that cast no shadow; None if there are none.
        rows: Gaussians that make up the scene; they determine the extent of the shadow maps.
        mean: Harmonics of all Gaussians under the mean light.
    """

    @torch.no_grad()
    def __init__(
        self,
        gaussians: Gaussians,
        sky: Bool[Tensor, " N"] | None,
        rows: Int[Tensor, " R"],
        mean: Float[Tensor, "N K 3"],
    ) -> None:
        opacities = gaussians.opacities
        self._shapes = (gaussians.means, gaussians.quats, gaussians.scales)
        self._opacities = opacities if sky is None else torch.where(sky, 0.0, opacities)
        self._mean = mean.contiguous()
        self._centre = gaussians.means[rows].median(dim=0).values
        self._radius = float(
            (gaussians.means[rows] - self._centre).norm(dim=1).quantile(0.95).clamp_min(1e-6)
        )
        self.directions = _directions().to(mean)
        self._cameras = [self._camera(direction) for direction in self.directions]
        self._maps = torch.stack([self._depth(camera) for camera in self._cameras])

    def _camera(self, direction: Float[Tensor, "3"]) -> Camera:
        """A camera at the place of the sun."""
        right = normalize(torch.linalg.cross(direction.new_tensor([0.0, 0.0, 1.0]), direction), dim=0)
        rotation = torch.stack([right, torch.linalg.cross(-direction, right), -direction])
        viewmat = torch.eye(4).to(direction)
        viewmat[:3, :3] = rotation
        viewmat[:3, 3] = -rotation @ (self._centre + _DISTANCE * self._radius * direction)
        focal, half = _MAP / 2 / _MARGIN * _DISTANCE, _MAP / 2
        K = direction.new_tensor([[focal, 0.0, half], [0.0, focal, half], [0.0, 0.0, 1.0]])
        return Camera(viewmat, K, _MAP, _MAP)

    def _depth(self, camera: Camera) -> Float[Tensor, "S S"]:
        rendering = self._rasterize(camera)
        return torch.where(rendering.alpha > 0.3, rendering.depth, torch.inf)

    def _rasterize(self, camera: Camera) -> Rendering:
        """Renders the scene without the sky."""
        degree = math.isqrt(self._mean.shape[1]) - 1
        return rasterize(*self._shapes, self._opacities, self._mean, camera, sh_degree=degree)

    @torch.no_grad()
    def direction(
        self, photo: Float[Tensor, "H W 3"], camera: Camera, masks: Sequence[Tensor | None] = ()
    ) -> Float[Tensor, "3"]:
        """The mean of the likely directions of the sun in a photo; shorter than 1 if it is uncertain.

        Args:
            photo: RGB in [0, 1].
            camera: Camera of the photo.
            masks: Images of any size; pixels where one of them is below 0.5 are ignored.
        """
        correlations = self._correlations(photo, camera, masks)
        return (correlations / _TEMPERATURE).softmax(dim=0) @ self.directions

    def _correlations(
        self, photo: Float[Tensor, "H W 3"], camera: Camera, masks: Sequence[Tensor | None]
    ) -> Float[Tensor, " D"]:
        """Correlation of a photo's brightness with the prediction for each direction; 0 if little is visible."""
        device = self._mean.device
        size = (camera.width, camera.height)
        shrink = min(1.0, SIDE / max(size))
        camera = camera.resized(*(max(4, round(shrink * side)) for side in size)).to(device)
        rendering = self._rasterize(camera)
        points = camera.unproject(rendering.depth)
        usable = (rendering.alpha > 0.9) & ((points - self._centre).norm(dim=-1) < 1.2 * self._radius)
        for mask in masks:
            usable &= True if mask is None else _reduced(mask.float()[..., None], camera)[..., 0] > 0.5
        usable[[0, -1]], usable[:, [0, -1]] = False, False
        chosen = usable.flatten().nonzero()[:, 0]
        chosen = chosen[:: max(1, len(chosen) // _PIXELS)]
        if len(chosen) < 100:
            return torch.zeros(len(self.directions), device=device)
        usual = _log_luminance(rendering.colors).flatten()[chosen]
        brightness = _log_luminance(_reduced(photo, camera)).flatten()[chosen] - usual
        brightness = (brightness - brightness.median()).clamp(-1.5, 1.5)
        predicted = self._predictions(
            points.reshape(-1, 3)[chosen], _normals(points, camera).reshape(-1, 3)[chosen]
        )
        predicted, brightness = without_tone(predicted, usual), without_tone(brightness, usual)
        return predicted @ brightness / (predicted.norm(dim=1) * brightness.norm()).clamp_min(1e-9)

    def _predictions(
        self, points: Float[Tensor, "P 3"], normals: Float[Tensor, "P 3"]
    ) -> Float[Tensor, "D P"]:
        """Log brightness of points under each sun, relative to the mean of all."""
        lit = torch.stack([self._lit(number, points) for number in range(len(self._cameras))])
        steepness = (self.directions @ normals.T).clamp_min(0)
        light = torch.log(_AMBIENT + lit * (_GRAZING + (1 - _GRAZING) * steepness))
        return light - light.mean(dim=0)

    def _lit(self, number: int, points: Float[Tensor, "P 3"]) -> Float[Tensor, " P"]:
        """How much a sun lights points: 0 in shadow, 1 in the open."""
        pixels, depths = self._cameras[number].project(points)
        column, row = pixels.long().clamp(0, _MAP - 1).unbind(dim=1)
        behind = (depths - self._maps[number, row, column]) / self._radius
        return torch.sigmoid((_BIAS - behind) / _BLUR)


def _directions() -> Float[Tensor, "D 3"]:
    """Unit vectors towards the sun in the aligned frame (+z up)."""
    height, turn = (
        part.flatten() for part in torch.meshgrid(_ELEVATIONS.deg2rad(), _AZIMUTHS.deg2rad(), indexing="ij")
    )
    return torch.stack([height.cos() * turn.cos(), height.cos() * turn.sin(), height.sin()], dim=1)


def _log_luminance(colors: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W"]:
    return (colors.clamp(0.02, 1.0) ** 2.2 @ colors.new_tensor([0.2126, 0.7152, 0.0722])).log()


def without_tone(values: Float[Tensor, "*D P"], usual: Float[Tensor, " P"]) -> Float[Tensor, "*D P"]:
    """Values less what a quadratic function of the usual brightness explains: exposure, contrast and tone curve."""
    scaled = (usual - usual.mean()) / usual.std().clamp_min(1e-6)
    basis = torch.linalg.qr(torch.stack([torch.ones_like(scaled), scaled, scaled.square()], dim=1))[0]
    return values - values @ basis @ basis.T


def _reduced(image: Float[Tensor, "h w C"], camera: Camera) -> Float[Tensor, "H W C"]:
    """An image at the size of a camera, on its device."""
    planes = image.to(camera.K.device).permute(2, 0, 1)[None]
    return interpolate(planes, (camera.height, camera.width), mode="area")[0].permute(1, 2, 0)


def _normals(points: Float[Tensor, "H W 3"], camera: Camera) -> Float[Tensor, "H W 3"]:
    """Normals of a depth map's surface, towards the camera; those at the border are undefined."""
    across, down = torch.zeros_like(points), torch.zeros_like(points)
    across[:, 1:-1] = points[:, 2:] - points[:, :-2]
    down[1:-1] = points[2:] - points[:-2]
    normals = normalize(torch.linalg.cross(down, across), dim=-1)
    return normals * ((camera.position - points) * normals).sum(dim=-1, keepdim=True).sign()
