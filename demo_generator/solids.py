"""Building blocks of the scene: solids with a pose, a material and a colour, in a hierarchy of boxes.

Frames are z-up and in metres. A solid stands on its origin: its own z runs upwards from 0 (but an ellipsoid
is centred).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int

from demo_generator.tracer_kernels import ARCH, BOX, ELLIPSOID, FRUSTUM, GABLE, PYRAMID

Vector = Sequence[float] | Float[np.ndarray, "3"]

_LEAF = 3


def rotation_about(axis: int, degrees: float) -> Float[np.ndarray, "3 3"]:
    """Rotation about a coordinate axis, right-handed."""
    angle = np.deg2rad(degrees)
    matrix = np.eye(3)
    i, j = [k for k in range(3) if k != axis]
    sign = -1.0 if axis == 1 else 1.0
    matrix[i, i] = matrix[j, j] = np.cos(angle)
    matrix[i, j], matrix[j, i] = -sign * np.sin(angle), sign * np.sin(angle)
    return matrix


@dataclass(frozen=True)
class World:
    """Solids as the ray caster reads them.

    Attributes:
        kind: Shape of each solid.
        pose: World-to-own rotation (row by row), then the origin in the world.
        size: What `Solids` describes for each shape, in metres.
        material: Index of the procedural texture.
        color: Base colour, linear RGB.
        node_boxes: Lower and upper corner of every node of the hierarchy.
        node_links: First child (or first entry of `order`), number of solids (0: an inner node), split axis.
        order: Solids in the order of the leaves.
    """

    kind: Int[np.ndarray, " N"]
    pose: Float[np.ndarray, "N 12"]
    size: Float[np.ndarray, "N 5"]
    material: Int[np.ndarray, " N"]
    color: Float[np.ndarray, "N 3"]
    node_boxes: Float[np.ndarray, "M 6"]
    node_links: Int[np.ndarray, "M 3"]
    order: Int[np.ndarray, " N"]

    @property
    def arrays(self) -> tuple[np.ndarray, ...]:
        """The fields in the order in which the kernels unpack them."""
        return (
            self.kind,
            self.pose,
            self.size,
            self.material,
            self.color,
            self.node_boxes,
            self.node_links,
            self.order,
        )


@dataclass
class Solids:
    """Collects solids; `frame` sets the pose of the solids added next."""

    frame_rotation: Float[np.ndarray, "3 3"] = field(default_factory=lambda: np.eye(3))
    frame_origin: Float[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))
    _rows: list[tuple] = field(default_factory=list)

    def frame(self, origin: Vector = (0.0, 0.0, 0.0), yaw: float = 0.0) -> Solids:
        """The same collection seen from a frame at `origin`, turned by `yaw` degrees about the vertical."""
        rotation = self.frame_rotation @ rotation_about(2, yaw)
        return Solids(rotation, self.frame_rotation @ np.asarray(origin) + self.frame_origin, self._rows)

    def __len__(self) -> int:
        return len(self._rows)

    def box(self, at: Vector, half: tuple[float, float], height: float, **look) -> None:
        """A box of given half widths in x and y."""
        self._add(BOX, at, (*half, height, 0.0, 0.0), **look)

    def frustum(self, at: Vector, radii: tuple[float, float], height: float, **look) -> None:
        """A cylinder or cone, radii at the bottom and at the top."""
        self._add(FRUSTUM, at, (max(radii[0], 1e-3), max(radii[1], 1e-3), height, 0.0, 0.0), **look)

    def ellipsoid(self, at: Vector, radii: Vector, cut: float = -1e6, **look) -> None:
        """An ellipsoid about `at`; what is below `cut` (own z) is taken away."""
        self._add(ELLIPSOID, at, (*(float(r) for r in radii), cut, 0.0), **look)

    def gable(self, at: Vector, half: tuple[float, float], height: float, **look) -> None:
        """A saddle roof with its ridge along y."""
        self._add(GABLE, at, (*half, height, 0.0, 0.0), **look)

    def pyramid(self, at: Vector, half: tuple[float, float], height: float, **look) -> None:
        """A pyramid over a rectangle."""
        self._add(PYRAMID, at, (*half, height, 0.0, 0.0), **look)

    def arch(self, at: Vector, half: tuple[float, float], height: float, opening: float, **look) -> None:
        """A wall piece with a round-headed opening of half width `opening` through it along y.

        The crown of the opening leaves a lintel as thick as the wall beside the opening.
        """
        spring = height - opening - (half[0] - opening)
        self._add(ARCH, at, (*half, height, opening, spring), **look)

    def _add(
        self,
        kind: int,
        at: Vector,
        size: tuple[float, ...],
        *,
        material: int,
        color: Vector,
        rotation: Float[np.ndarray, "3 3"] | None = None,
    ) -> None:
        own_to_world = self.frame_rotation if rotation is None else self.frame_rotation @ rotation
        origin = self.frame_rotation @ np.asarray(at, dtype=float) + self.frame_origin
        self._rows.append((kind, own_to_world.T, origin, size, material, tuple(color)))

    def build(self) -> World:
        """The solids with their hierarchy."""
        n = len(self._rows)
        kind = np.array([row[0] for row in self._rows], dtype=np.int64)
        pose = np.array([np.append(row[1].ravel(), row[2]) for row in self._rows]).reshape(n, 12)
        size = np.array([row[3] for row in self._rows], dtype=float).reshape(n, 5)
        boxes = np.array([_bounds(k, p, s) for k, p, s in zip(kind, pose, size, strict=True)]).reshape(n, 6)
        node_boxes, node_links, order = _hierarchy(boxes)
        material = np.array([row[4] for row in self._rows], dtype=np.int64)
        color = np.array([row[5] for row in self._rows], dtype=float).reshape(n, 3)
        return World(kind, pose, size, material, color, node_boxes, node_links, order)


def _bounds(kind: np.integer, pose: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Lower and upper corner of a solid in the world."""
    if kind == ELLIPSOID:
        low, high = np.array([-size[0], -size[1], max(-size[2], size[3])]), size[:3]
    else:
        wide = np.array([max(size[0], size[1])] * 2) if kind == FRUSTUM else size[:2]
        low, high = np.append(-wide, 0.0), np.append(wide, size[2])
    corners = np.stack(np.meshgrid(*np.stack([low, high], axis=1)), axis=-1).reshape(-1, 3)
    corners = corners @ pose[:9].reshape(3, 3) + pose[9:]
    return np.concatenate([corners.min(axis=0) - 1e-6, corners.max(axis=0) + 1e-6])


def _hierarchy(boxes: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Nodes by splits that make the expected cost of a ray small (surface area heuristic, full sweep)."""
    if len(boxes) == 0:
        return np.zeros((0, 6)), np.zeros((0, 3), dtype=np.int64), np.zeros(0, dtype=np.int64)
    centers = (boxes[:, :3] + boxes[:, 3:]) / 2
    node_boxes, node_links, order = [np.zeros(6)], [[0, 0, 0]], []
    pending = [(0, np.arange(len(boxes)))]
    while pending:
        node, members = pending.pop()
        node_boxes[node] = np.concatenate([boxes[members, :3].min(axis=0), boxes[members, 3:].max(axis=0)])
        if len(members) <= _LEAF:
            node_links[node] = [len(order), len(members), 0]
            order.extend(members.tolist())
            continue
        axis, members, first = _best_split(boxes, centers, members)
        node_links[node] = [len(node_links), 0, axis]
        for half in (members[:first], members[first:]):
            pending.append((len(node_links), half))
            node_boxes.append(np.zeros(6))
            node_links.append([0, 0, 0])
    return np.array(node_boxes), np.array(node_links, dtype=np.int64), np.array(order, dtype=np.int64)


def _best_split(boxes: np.ndarray, centers: np.ndarray, members: np.ndarray) -> tuple[int, np.ndarray, int]:
    """The axis, the members sorted along it and how many go to the first half."""
    best_cost, best = np.inf, (0, members, len(members) // 2)
    counts = np.arange(1, len(members))
    for axis in range(3):
        sorted_members = members[np.argsort(centers[members, axis], kind="stable")]
        sorted_boxes = boxes[sorted_members]
        before, after = _growing_areas(sorted_boxes)[:-1], _growing_areas(sorted_boxes[::-1])[::-1][1:]
        cost = before * counts + after * counts[::-1]
        first = int(np.argmin(cost))
        if cost[first] < best_cost:
            best_cost, best = cost[first], (axis, sorted_members, first + 1)
    return best


def _growing_areas(boxes: np.ndarray) -> np.ndarray:
    """Half the surface of the box around the first one, two, three, ... boxes."""
    low, high = np.minimum.accumulate(boxes[:, :3]), np.maximum.accumulate(boxes[:, 3:])
    side = high - low
    return side[:, 0] * side[:, 1] + side[:, 1] * side[:, 2] + side[:, 2] * side[:, 0]
