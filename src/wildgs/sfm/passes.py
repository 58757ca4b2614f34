"""The passes of structure from motion: mapping, two further passes for photos that are left out, and refinement."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from wildgs.progress import Progress
from wildgs.sfm.config import SfmConfig
from wildgs.sfm.enlarged import enlarge_small
from wildgs.sfm.incremental import measure_distortion
from wildgs.sfm.lenses import drop_impossible
from wildgs.sfm.mapping import missing_from, names_of
from wildgs.sfm.matching import describe_photos, extract, match
from wildgs.sfm.pairs import Pairing
from wildgs.sfm.placement import Findings, PassName
from wildgs.sfm.registration import Registration
from wildgs.sfm.repeated_mapping import map_repeatedly
from wildgs.sfm.upright import WorkingCopy
from wildgs.sfm.workplace import Workplace


@dataclass(frozen=True)
class Poses:
    """Result of all passes.

    Attributes:
        models: All models; the first one is kept.
        pairing: The matched pairs.
        passes: The pass that registered a photo, if not the first, by name of its working copy.
        findings: Further findings about photos.
    """

    models: list[Any]
    pairing: Pairing
    passes: dict[str, PassName]
    findings: Findings


def find_poses(
    work: Workplace, copies: Sequence[WorkingCopy], config: SfmConfig, progress: Progress
) -> Poses | None:
    """Computes features, matches and poses of the working copies; None if no photos match.

    Features, matches and models of the first pass of an interrupted call are reused from the workplace.
    """
    extract(work, copies, config, progress)
    progress("choosing pairs", 0, 0)
    vlads = describe_photos(work, copies, config.seed)
    pairing, crops = match(work, copies, vlads, config, progress)
    models = work.load_models("first")
    if models is None:
        models = map_repeatedly(work, copies, config, progress)
        work.save_models("first", models)
    photos = Registration(work, copies, vlads, config, progress, frozenset(crops))
    if config.second_chance:
        if models:
            drop_impossible(models[0])  # the next passes try these photos again
            _enlarge_missing(photos, models[0])
        models, more = photos.try_again(models)
        pairing = Pairing(pairing.name, tuple(sorted({*pairing.pairs, *more})))
    if not models:
        return None
    models[0] = photos.refine(measure_distortion(work, models[0], len(copies)))
    lenses = drop_impossible(models[0])
    if lenses and config.second_chance:
        models[0] = photos.place_with_plain_lens(models[0], set(lenses))
        lenses |= drop_impossible(models[0])
        lenses = {name: why for name, why in lenses.items() if name not in names_of(models[0])}
    return Poses(models, pairing, photos.passes, Findings(crops, lenses, photos.contradicted))


def _enlarge_missing(photos: Registration, model: Any) -> None:
    """Enlarges small photos without a pose, once."""
    work = photos.work
    if not work.is_done("enlarged"):
        missing = set(missing_from(model, photos.copies)) - photos.crops
        enlarge_small(work, photos.copies, missing, photos.config.max_features)
        work.set_done("enlarged")
