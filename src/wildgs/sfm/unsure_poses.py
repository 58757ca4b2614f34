"""Removal of photos whose poses are not reliable from a model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from wildgs.sfm.incremental import LEAST_GROUP
from wildgs.sfm.lookalike_groups import find_contradicted_group
from wildgs.sfm.lookalikes import LEAST_MATCHES, VERIFIED, JudgedPair, find_doubtful, judge_pairs
from wildgs.sfm.mapping import names_of
from wildgs.sfm.placement import PassName, count_neighbours
from wildgs.sfm.workplace import Workplace

LEAST_POINTS = 10
"""Smallest number of sparse points of a photo registered by a later pass."""

FEW_NEIGHBOURS = 5
"""Number of neighbours below which pairs with few matches count against a pose, too. Of 35 photos of a generated
landmark, three had poses 88 to 120 degrees off, by matches between sides of the building that look alike. They had
0 to 4 neighbours and more matches against than for them; no other photo had both."""


def drop_unsure(
    model: Any, work: Workplace, passes: Mapping[str, PassName], names: Mapping[str, str]
) -> dict[str, str]:
    """Removes photos whose poses are not reliable.

    First, single photos. Those registered by a later pass have too few points, are contradicted by most of their
    matches, or share few points with every other photo; of the first pass, both of the latter. Photos with few
    neighbours are removed if most of their matches contradict them when pairs with few matches count as well.
    Repeated architecture, like the sides of an octagonal tower, gives points scattered over many photos.

    Then groups that agree among themselves but not with the rest (`wildgs.sfm.lookalike_groups`), which may be
    single photos, too. Three photos are left.

    Args:
        model: pycolmap's reconstruction, which is modified.
        work: The workplace, whose database contains the verified matches.
        passes: The pass that registered a photo, if not the first, by name of its working copy.
        names: Names of the photos for messages, by name of the working copy.

    Returns:
        Why poses were contradicted, by name of the working copy; photos removed for another reason are not in it.
    """
    pairs = judge_pairs(model, work.database, VERIFIED)
    return _drop_photos(model, pairs, passes, names) | _drop_groups(model, pairs)


def _drop_photos(
    model: Any, pairs: Sequence[JudgedPair], passes: Mapping[str, PassName], names: Mapping[str, str]
) -> dict[str, str]:
    outweighed = find_doubtful(pairs, names)
    doubtful = find_doubtful([pair for pair in pairs if pair.matches >= LEAST_MATCHES], names)
    reasons = {}
    for image_id in list(model.reg_image_ids()):
        image, neighbours = model.image(image_id), count_neighbours(model, model.image(image_id))
        contradicted, alone = image.name in doubtful, not neighbours
        if neighbours < FEW_NEIGHBOURS and image.name in outweighed and model.num_reg_images() > LEAST_GROUP:
            unsure = contradicted = True
        elif image.name in passes:
            unsure = contradicted or alone or image.num_points3D < LEAST_POINTS
        else:
            unsure = contradicted and alone
        if unsure:
            model.deregister_frame(image.frame_id)
        if unsure and contradicted:
            reasons[image.name] = (doubtful | outweighed)[image.name]
    return reasons


def _drop_groups(model: Any, pairs: Sequence[JudgedPair]) -> dict[str, str]:
    """Removes the group that is contradicted most, until there is none."""
    reasons = {}
    while True:
        left = names_of(model)
        group = find_contradicted_group([pair for pair in pairs if left.issuperset(pair.photos)])
        if group is None or len(left) - len(group.photos) < LEAST_GROUP:
            return reasons
        for name in group.photos:
            model.deregister_frame(model.find_image_with_name(name).frame_id)
            reasons[name] = (
                f"{group.against} of the {group.against + group.supported} matches with the rest of the scene"
                f" contradict the pose of its group of {len(group.photos)} photos"
                if len(group.photos) > 1
                else f"{group.against} of its {group.against + group.supported} matches contradict its pose"
            )
