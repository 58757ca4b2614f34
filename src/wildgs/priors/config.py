"""Configuration of depth estimation and of initial Gaussians from priors."""

from __future__ import annotations

from dataclasses import dataclass

from wildgs.errors import UserError

DEPTH_ANYTHING = "depth-anything/Depth-Anything-V2-Small-hf"

CELLS = 24
"""Cells along each side of a photo that are displaced independently."""
LEAST_SHARE = 0.08
"""Smallest share of the variance that residuals of neighbouring features have in common if photos are displaced.

It is 0.12 to 0.23 in collections from the web, and 0 to 0.06 where cameras are exact or features few.
"""


@dataclass(frozen=True)
class DepthPointsConfig:
    """Initial Gaussians from depth maps; scenes without depth maps have none.

    Attributes:
        points: Upper bound on the number of points; 0 starts from SfM points only, as in the paper.
        cell: Size of the voxels in which photos have to agree, in units of the aligned frame (median depth of the
            photos = 1).
        support: Number of photos that have to see a surface in a voxel.
        agreement: Smallest fraction of the photos looking at a voxel that see the surface in it rather than behind
            it.
        farthest: Largest distance of a point from its camera, in units of the aligned frame.
    """

    points: int = 20_000
    cell: float = 0.02
    support: int = 3
    agreement: float = 0.3
    farthest: float = 4.0


@dataclass(frozen=True)
class GroundConfig:
    """Initial Gaussians that extend the ground plane, if the scene has a level ground.

    Attributes:
        points: Upper bound on the number of points; 0 = none, as in the paper.
        spacing: Distance between points, in units of the aligned frame (median depth of the photos = 1).
        most_pixels: Largest distance between neighbouring points in a training photo, in pixels. Where photos are
            nearer, points are denser. 0 = the same distance everywhere.
        reach: Distance from the cameras up to which the ground is extended, in units of the aligned frame.
        tolerance: Largest distance from the ground plane, in units of the aligned frame, of points that show it.
            It is not extended where they are, and new points take their colours.
    """

    points: int = 12_000
    spacing: float = 0.04
    most_pixels: float = 12.0
    reach: float = 1.0
    tolerance: float = 0.03


@dataclass(frozen=True)
class StereoConfig:
    """Depth by multi-view stereo.

    Attributes:
        max_side: Longer side of the photos for matching, pixels.
        neighbours: Upper bound on the number of source photos per reference photo.
        agreeing: Number of source photos that have to confirm a depth.
        max_cost: Largest matching cost, 1 - NCC, of a pixel that gets a depth.
        tolerance: Largest relative difference between depths that agree.
        reach: Largest reprojection error, in pixels, from the reference photo to a source photo and back.
        support: Number of pixels in a 7 x 7 window that have to agree with the plane of the central pixel.
        seed: Random seed of the initial planes.
    """

    max_side: int = 400
    neighbours: int = 6
    agreeing: int = 2
    max_cost: float = 0.8
    tolerance: float = 0.015
    reach: float = 1.5
    support: int = 16
    seed: int = 0

    def __post_init__(self) -> None:
        """Validates the values; NaN is rejected as well."""
        ranges = {
            "max_side": (32, 4096),
            "neighbours": (1, 64),
            "agreeing": (1, self.neighbours),
            "max_cost": (0, 2),
            "tolerance": (1e-6, 1),
            "reach": (1e-3, 1e3),
            "support": (0, 49),
            "seed": (0, 2**31 - 1),
        }
        for name, (least, most) in ranges.items():
            value = getattr(self, name)
            if not least <= value <= most:
                option = name.replace("_", "-")
                raise UserError(f"--stereo.{option} {value}: must be from {least:g} to {most:g}")
