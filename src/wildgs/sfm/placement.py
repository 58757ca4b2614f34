"""How each photo was registered, and why the others were not."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from wildgs.sfm.database import open_database
from wildgs.sfm.incremental import LEAST_GROUP
from wildgs.sfm.mapping import find_registered, missing_from
from wildgs.sfm.matching import image_ids, verified_pairs
from wildgs.sfm.pairs import Pair
from wildgs.sfm.upright import WorkingCopy
from wildgs.sfm.workplace import Workplace

PassName = Literal["first", "second", "third"]

NEIGHBOUR_POINTS = 15
"""Smallest number of points shared with a neighbour."""

GROUP_MATCHES = 30
"""Smallest number of matches between photos without a pose that show the same thing."""

LOOKALIKES = "places or sides that look alike were taken for one another; photos taken in between would help"


@dataclass(frozen=True)
class Placement:
    """Reliability of the pose of a photo.

    Attributes:
        placed_by: The pass that registered it: the first; the second, by matches to points; or the third, with more
            pairs and fewer inliers.
        points: Number of sparse points that the photo observes.
        reprojection_error: Their mean reprojection error, pixels.
        neighbours: Number of photos that share at least 15 points with it.
    """

    placed_by: PassName
    points: int
    reprojection_error: float
    neighbours: int


def placements(
    model: Any, copies: Sequence[WorkingCopy], passes: Mapping[str, PassName]
) -> dict[str, Placement]:
    """The placement of each photo of a model by name in the scene; `passes` is by name of the working copy."""
    result = {}
    for copy in copies:
        image = find_registered(model, copy)
        if image is None:
            continue
        errors = []
        for observation in image.get_observation_points2D():
            projected = image.project_point(model.point3D(observation.point3D_id).xyz)
            if projected is not None:
                errors.append(float(np.linalg.norm(projected - observation.xy)))
        error = float(np.mean(errors)) if errors else 0.0
        placed_by, neighbours = passes.get(copy.work_name, "first"), count_neighbours(model, image)
        result[copy.scene_name] = Placement(placed_by, image.num_points3D, round(error, 3), neighbours)
    return result


def count_neighbours(model: Any, image: Any) -> int:
    """Number of photos that share at least `NEIGHBOUR_POINTS` points with an image of a model."""
    shared: Counter[int] = Counter()
    for observation in image.get_observation_points2D():
        track = model.point3D(observation.point3D_id).track
        shared.update({element.image_id for element in track.elements})
    del shared[image.image_id]
    return sum(count >= NEIGHBOUR_POINTS for count in shared.values())


@dataclass(frozen=True)
class Failure:
    """Why a photo has no pose.

    Attributes:
        reason: The reason as text.
        partner: The photo with which it has the most matches, if any.
        group: Names of the photos that show the same other place or side, itself included; empty if there are none.
    """

    reason: str
    partner: str | None = None
    group: tuple[str, ...] = ()


def other_places(failed: Iterable[Failure]) -> tuple[tuple[str, ...], ...]:
    """The groups of photos that show another place or side than the scene, largest first."""
    groups = {failure.group for failure in failed if failure.group}
    return tuple(sorted(groups, key=lambda group: (-len(group), group)))


@dataclass(frozen=True)
class Findings:
    """Findings about photos during mapping.

    Attributes:
        crops: Originals of copies and crops, as indices of photos.
        lenses: Problems of lenses, by name of the working copy.
        contradicted: Why photos lost their pose, if their matches contradict it, by name of the working copy.
    """

    crops: Mapping[int, int] = field(default_factory=dict)
    lenses: Mapping[str, str] = field(default_factory=dict)
    contradicted: Mapping[str, str] = field(default_factory=dict)


def failures(
    work: Workplace, copies: Sequence[WorkingCopy], models: Sequence[Any], findings: Findings
) -> dict[str, Failure]:
    """Reasons why photos have no pose in the first model, by name."""
    with open_database(work.database) as database:
        ids = image_ids(database, copies)
        found = verified_pairs(database, copies)
        blank = {row for row, i in enumerate(ids) if i is None or database.num_keypoints_for_image(i) == 0}
    best: dict[int, tuple[int, int]] = {}
    for (a, b), inliers in found.items():
        best[a] = max(best.get(a, (0, 0)), (inliers, b))
        best[b] = max(best.get(b, (0, 0)), (inliers, a))
    missing = missing_from(models[0], copies)
    together = [
        [row for row in missing if find_registered(model, copies[row]) is not None] for model in models[1:]
    ]
    groups = find_groups(missing, found, together)
    result = {}
    for row in missing:
        inliers, partner = best.get(row, (0, row))
        reason = _own_reason(row, copies, findings, blank)
        group: tuple[str, ...] = ()
        if reason is None and len(groups[row]) >= LEAST_GROUP:
            group = tuple(sorted(copies[member].name for member in groups[row]))
        if reason is None and copies[row].work_name in findings.contradicted:
            reason = f"lost its pose: {findings.contradicted[copies[row].work_name]}; {LOOKALIKES}"
        reason = reason or _reason(copies[row], copies[partner], models[0], group, inliers)
        result[copies[row].name] = Failure(reason, copies[partner].name if inliers else None, group)
    return result


def find_groups(
    missing: Sequence[int], found: Mapping[Pair, int], together: Iterable[Sequence[int]] = ()
) -> dict[int, list[int]]:
    """The photos without a pose that each of them belongs with, itself included.

    They are linked by matches with each other, or are `together` in a smaller model.

    Args:
        missing: Photos without a pose.
        found: Number of verified matches by pair of photos.
        together: Photos of each smaller model.
    """
    group = {row: [row] for row in missing}
    matched = [pair for pair, inliers in found.items() if inliers >= GROUP_MATCHES]
    for a, b in [*matched, *((rows[0], row) for rows in together for row in rows[1:])]:
        if a in group and b in group and group[a] is not group[b]:
            group[a] += group[b]
            group |= dict.fromkeys(group[b], group[a])
    return group


def _own_reason(
    row: int, copies: Sequence[WorkingCopy], findings: Findings, blank: Collection[int]
) -> str | None:
    """A reason that concerns the photo itself, independent of its matches; None if there is none."""
    if row in blank:
        return "no features found (blank, blurred or very small)"
    if copies[row].work_name in findings.lenses:
        return findings.lenses[copies[row].work_name]
    if row in findings.crops:
        return f"a copy or crop of {copies[findings.crops[row]].name}, which has no pose"
    return None


def _reason(copy: WorkingCopy, partner: WorkingCopy, model: Any, group: Sequence[str], inliers: int) -> str:
    """The reason by matches: the photo's group, or the partner with which it has the most matches."""
    if group:
        names = ", ".join([name for name in group if name != copy.name][:3])
        return (
            f"belongs to a separate group of {len(group)} photos (with {names}) with too few matches to the"
            " scene, because they show another side or another place; photos taken in between would connect them"
        )
    if inliers == 0:
        return "matches no other photo"
    if find_registered(model, partner) is None:
        return f"the photo that it matches best, {partner.name} ({inliers} matches), has no pose either"
    return f"too few matches with the scene ({inliers} at most, with {partner.name})"
