"""PatchMatch search for the planes of one photo, coarse to fine; the fine level uses its neighbours' planes too."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from scipy.spatial import KDTree
from torch import Tensor

from wildgs.geometry.camera import Camera
from wildgs.priors.stereo.agreement_kernels import carry_planes
from wildgs.priors.stereo.cost_kernels import WORST, window_offsets
from wildgs.priors.stereo.photos import Level, Planes, enlarged
from wildgs.priors.stereo.search_kernels import BAND, first_planes, improve_planes
from wildgs.scene import View
from wildgs.threads import launch, run_once

_GUESSES = 4
_DRAWS = 16
_COARSE_SPREADS = (0.1, 0.05, 0.03, 0.02)
_FINE_SPREADS = (0.02, 0.005)
_NEARER, _FARTHER = 2.0, 50.0
"""Depth range of the search, as factors on the range of the points that a photo observes.

The far limit is generous: background beyond it would match at a wrong, nearer depth.
"""


@dataclass(frozen=True)
class Search:
    """The search for the planes of one photo.

    Attributes:
        photo: Index of the photo.
        others: Indices of its neighbours.
        guesses: Initial inverse depths, at half the resolution.
        bounds: Minimum and maximum inverse depth.
        up: Up direction of the world in the camera's frame.
        mask: The user's mask; None if there is none.
        seed: Seed of the random planes.
    """

    photo: int
    others: list[int]
    guesses: Float32[np.ndarray, "h w G"]
    bounds: Float32[np.ndarray, "2"]
    up: Float32[np.ndarray, "3"]
    mask: UInt8[np.ndarray, "H W"] | None
    seed: int

    @classmethod
    def of(
        cls,
        view: View,
        photo: int,
        others: list[int],
        seen: Float[Tensor, "P 3"],
        ground: Float[Tensor, "3"] | None,
        camera: Camera,
        seed: int,
    ) -> Search | None:
        """Prepares the search for a photo.

        Args:
            view: The photo.
            photo: Index of the photo.
            others: Indices of its neighbours.
            seen: Points that the photo observes.
            ground: Ground plane of the scene, if it was found (see `find_ground`).
            camera: Camera of the photo at half the resolution.
            seed: Seed of the random planes.

        Returns:
            None if the photo has no neighbours, or no points from which the depth range follows.
        """
        seen = seen[view.camera.project(seen)[1] > 0]
        if not others or len(seen) == 0:
            return None
        nearness = 1 / view.camera.project(seen)[1].double()
        guesses = _guesses(camera, seen, ground)
        low, high = (float(nearness.quantile(share)) for share in (0.01, 0.99))
        bounds = np.array([low / _FARTHER, max(high, float(guesses.max())) * _NEARER], np.float32)
        up = view.camera.viewmat[:3, 2].numpy().astype(np.float32)
        mask = view.read_mask()
        return cls(photo, others, guesses, bounds, up, None if mask is None else mask.numpy(), seed)

    def begin(self, level: Level, found: Planes) -> None:
        """Finds planes at half the resolution, from initial and random ones, by matching cost alone."""
        offsets, no_planes = window_offsets(), np.zeros((0, 3), np.float32)
        planes, costs = found.of(self.photo)
        arguments = self._arguments(level, no_planes, level.layout)
        candidates = (self.up, self.guesses, _DRAWS, self.seed, offsets, planes, costs)
        launch(first_planes, *arguments, *candidates, items=len(costs))
        self._improve(arguments, _COARSE_SPREADS, no_planes[None], planes, costs)

    def refine(self, coarse: Level, found: Planes, level: Level, refined: Planes) -> None:
        """Refines coarse planes, with a penalty for disagreement with the neighbours' planes."""
        hints = np.zeros_like(found.of(self.photo)[0])
        hint_costs = np.full(hints.shape[:2], WORST, np.float32)
        back = coarse.motions(self.photo, self.others)
        for other, there, motion in zip(
            self.others, back, coarse.returns(self.photo, self.others), strict=True
        ):
            run_once(carry_planes, *found.of(other), motion, there, hints, hint_costs)
        planes, costs = refined.of(self.photo)
        planes[:] = enlarged(found.of(self.photo)[0], costs.shape[1], costs.shape[0])
        hints = enlarged(hints, costs.shape[1], costs.shape[0])
        arguments = self._arguments(level, found.planes, coarse.layout)
        self._improve(arguments, _FINE_SPREADS, hints, planes, costs)
        if self.mask is not None:
            costs[self.mask == 0] = WORST

    def _arguments(self, level: Level, coarse: np.ndarray, coarse_layout: np.ndarray) -> tuple:
        K = level.cameras[self.photo].K
        intrinsics = np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]], np.float32)
        motions = level.motions(self.photo, self.others)
        best = min(3, math.ceil(len(self.others) / 2))
        pictures = (level.pixels, level.blocks, level.layout, self.photo, np.array(self.others), motions)
        return (*pictures, coarse, coarse_layout, best), intrinsics, self.bounds

    def _improve(
        self,
        arguments: tuple,
        spreads: Sequence[float],
        hints: np.ndarray,
        planes: np.ndarray,
        costs: np.ndarray,
    ) -> None:
        offsets = window_offsets()
        for number, spread in enumerate(spreads):
            for colour in (0, 1):
                own = (colour, np.float32(spread), self.seed + 101 * number, hints, offsets, planes, costs)
                launch(improve_planes, *arguments, *own, items=-(-len(costs) // BAND))


def _guesses(
    camera: Camera, points: Float[Tensor, "P 3"], ground: Float[Tensor, "3"] | None
) -> Float32[np.ndarray, "H W G"]:
    """Inverse depths of the points nearest to each pixel, followed by that of the ground if it was found."""
    pixels, z = camera.project(points)
    pixels, z = pixels[z > 0].numpy(), z[z > 0].numpy()
    y, x = np.mgrid[: camera.height, : camera.width]
    centers = np.stack([x.ravel() + 0.5, y.ravel() + 0.5], axis=1)
    nearest = KDTree(pixels).query(centers, k=min(_GUESSES, len(z)))[1]
    guesses = (1 / z)[nearest].reshape(camera.height, camera.width, -1)
    if ground is not None:
        upward = torch.tensor([-float(ground[0]), -float(ground[1]), 1.0])
        falling = camera.pixel_rays() @ (camera.viewmat[:3, :3] @ upward)
        nearness = (falling / (ground[2] - upward @ camera.position)).numpy()[..., None]
        guesses = np.concatenate([guesses, np.where(nearness > 0, nearness, guesses[..., :1])], axis=2)
    return guesses.astype(np.float32)
