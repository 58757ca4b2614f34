"""Finds groups of photos that are joined to the rest of a model by a look-alike.

Photos of another side of a building may agree with each other and have wrong poses all the same, because one or
two photos of a look-alike joined them to the model. Most matches of each photo, which are with its own group, agree
with its pose then, but most of those between the group and the rest do not. A maximum spanning tree of the pairs
gives one part of the photos for each of its edges; the parts are judged by the matches of all pairs between them
and the rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree

from wildgs.sfm.lookalikes import JudgedPair

LEAST_AGAINST = 100
"""Smallest number of contradicting matches by which a group is judged."""

LEAST_RATIO = 2.0
"""Ratio of contradicting to agreeing matches with the rest above which the poses of a group are wrong. Six of
20 photos of `gate` that were 122 degrees off as a group had 19.6; photos with right poses had at most 0.9 in a
generated landmark (31 photos), 0.3 in `longchamp` (58) and 0.1 in `arch` (16)."""


@dataclass(frozen=True)
class ContradictedGroup:
    """Photos whose matches with the rest of a model contradict their poses.

    Attributes:
        photos: Names of the images.
        against: Number of contradicting matches with the rest.
        supported: Number of agreeing ones.
    """

    photos: frozenset[str]
    against: int
    supported: int

    @property
    def ratio(self) -> float:
        """Contradicting matches per agreeing match."""
        return self.against / max(self.supported, 1)


def find_contradicted_group(pairs: Sequence[JudgedPair]) -> ContradictedGroup | None:
    """The group of photos that its matches with the rest contradict most; None if there is none.

    Args:
        pairs: Verified pairs compared with the poses.
    """
    names = sorted({name for pair in pairs for name in pair.photos})
    if not names:
        return None
    row_of = {name: row for row, name in enumerate(names)}
    ends = np.array([[row_of[name] for name in pair.photos] for pair in pairs])
    matches = np.array([pair.matches for pair in pairs])
    agrees = np.array([pair.agrees for pair in pairs])
    groups = [
        ContradictedGroup(
            frozenset(names[row] for row in np.flatnonzero(part)),
            int(matches[crossing & ~agrees].sum()),
            int(matches[crossing & agrees].sum()),
        )
        for part in _parts(_spanning_tree(ends, matches, agrees, len(names)))
        for crossing in [part[ends[:, 0]] != part[ends[:, 1]]]
    ]
    wrong = [group for group in groups if group.against >= LEAST_AGAINST and group.ratio > LEAST_RATIO]
    return max(wrong, key=lambda group: (group.ratio, -len(group.photos)), default=None)


def _spanning_tree(
    ends: Int[np.ndarray, "P 2"], matches: Int[np.ndarray, " P"], agrees: Bool[np.ndarray, " P"], photos: int
) -> Any:
    """The tree whose pairs have the most matches; pairs that contradict the poses come after all others.

    Where the graph is not connected, there is one tree for each component.
    """
    cost = 1 / matches + ~agrees  # of agreeing pairs 1 at most
    graph = coo_array((cost, (ends[:, 0], ends[:, 1])), shape=(photos, photos))
    return minimum_spanning_tree(graph.tocsr()).tocoo()


def _parts(tree: Any) -> list[Bool[np.ndarray, " N"]]:
    """For each edge of a tree, the smaller one of the two parts into which it divides the photos."""
    parts = []
    for edge in range(tree.nnz):
        rest = np.arange(tree.nnz) != edge
        cut = coo_array((tree.data[rest], (tree.row[rest], tree.col[rest])), shape=tree.shape)
        labels = connected_components(cut, directed=False)[1]
        sides = [labels == labels[end] for end in (tree.row[edge], tree.col[edge])]
        parts.append(min(sides, key=np.count_nonzero))
    return parts
