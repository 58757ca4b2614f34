"""Configuration of the first Gaussians that come from priors."""

from __future__ import annotations

from dataclasses import dataclass

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
