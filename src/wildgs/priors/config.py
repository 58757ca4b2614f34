"""Configuration of the first Gaussians that come from priors."""

from __future__ import annotations

from dataclasses import dataclass

from wildgs.errors import UserError

DEPTH_ANYTHING = "depth-anything/Depth-Anything-V2-Small-hf"


@dataclass(frozen=True)
class DepthPointsConfig:
    """Initial points from depth priors; scenes without depth priors have none.

    Attributes:
        points: At most so many; 0 starts from SfM points alone, as the paper does.
        cell: Side of the cells in which photos have to agree, in units of the aligned frame (photos' median depth).
        support: Photos that have to see a surface in a cell.
        agreement: Of the photos that look at a cell, least share that see the surface there and not beyond.
        farthest: Nothing further from a camera than this, in units of the aligned frame.
    """

    points: int = 20_000
    cell: float = 0.02
    support: int = 3
    agreement: float = 0.3
    farthest: float = 4.0


@dataclass(frozen=True)
class GroundConfig:
    """Gaussians that continue the ground at the start, where it is level and known in part.

    Attributes:
        points: At most so many; 0 leaves holes, as the paper does.
        spacing: Between them, in units of the aligned frame (photos' median depth).
        reach: How far around the cameras the ground is continued, likewise.
        tolerance: Height within which a point belongs to the plane, likewise.
    """

    points: int = 6000
    spacing: float = 0.04
    reach: float = 1.0
    tolerance: float = 0.03


@dataclass(frozen=True)
class StereoConfig:
    """Depth by multi-view stereo.

    Attributes:
        max_side: Photos are compared at this size (longer side), pixels.
        neighbours: Photos with which each is compared, at most.
        agreeing: Neighbours that have to see the surface where a photo sees it.
        max_cost: 1 - NCC of a window beyond which nothing is said.
        tolerance: Difference of depth within which photos agree, as a share of it.
        reach: Pixels within which a point carried to a neighbour and back has to arrive.
        support: Pixels of the 7 x 7 around a pixel that its plane has to hold for.
        seed: Of random planes.
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
        """Refuses values with which nothing can be compared, NaN among them."""
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
