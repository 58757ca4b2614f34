"""Registration of photos that the first pass of structure from motion leaves out."""

from __future__ import annotations

from collections.abc import Collection, Sequence, Set
from dataclasses import dataclass, field, replace
from typing import Any

from jaxtyping import Float
from torch import Tensor

from wildgs.progress import Progress, counter
from wildgs.sfm.config import SfmConfig
from wildgs.sfm.database import open_database
from wildgs.sfm.guided_matching import GuidedMatches
from wildgs.sfm.incremental import LEAST_GROUP, by_size
from wildgs.sfm.lookalikes import keeps_agreement
from wildgs.sfm.mapping import (
    continue_mapping,
    lenses_of,
    map_photos,
    missing_from,
    names_of,
)
from wildgs.sfm.matching import forget_pairs, match_pairs, verified_pairs
from wildgs.sfm.pairs import Pair, alike_pairs, friends_of_friends
from wildgs.sfm.placement import PassName, find_groups
from wildgs.sfm.point_matching import match_to_points
from wildgs.sfm.refinement import refine
from wildgs.sfm.repeated_mapping import is_better, map_repeatedly
from wildgs.sfm.unsure_poses import drop_unsure
from wildgs.sfm.upright import WorkingCopy
from wildgs.sfm.workplace import Workplace

ENOUGH_MATCHES = 60
"""Number of matches from which a pair is not matched again."""

POINT_ROUNDS = 5
"""Upper bound on rounds of matching to points; newly registered photos add points for others."""

AGAIN_LIMIT = 40
"""Number of photos up to which all of them are matched and mapped again if some have no pose. Of 20 photos of
`gate`, 17 have a pose then instead of 15, and of another choice 10 instead of 4."""


@dataclass
class Registration:
    """Photos of a collection whose features are matched, and what the later passes found.

    Models are never modified, except that photos with unsure poses are removed.

    Attributes:
        work: The workplace, whose database contains features and matches.
        copies: All photos.
        vlads: Their VLAD descriptors.
        config: Options.
        progress: Called during matching and mapping.
        crops: Photos that are crops of others; these are not matched again.
        passes: The pass that registered a photo, if not the first, by name of its working copy.
        contradicted: Why photos lost their pose, by name of the working copy, if their matches contradict it. Some
            of them may have another one now.
        guided: Guided matches, kept from one refinement to the next.
    """

    work: Workplace
    copies: Sequence[WorkingCopy]
    vlads: Float[Tensor, "N D"]
    config: SfmConfig
    progress: Progress
    crops: Set[int] = frozenset()
    passes: dict[str, PassName] = field(default_factory=dict)
    contradicted: dict[str, str] = field(default_factory=dict)
    guided: GuidedMatches = field(default_factory=dict)

    def try_again(self, models: list[Any]) -> tuple[list[Any], set[Pair]]:
        """Runs the second and third pass.

        Returns:
            All models, and the pairs that were matched again.
        """
        if models:
            self._drop_unsure(models[0])
            models = [self._place_by_points(models[0], "second"), *models[1:]]
            if not self.missing(models[0]):
                return models[:1], set()
        more = self._more_pairs(models)
        if not self.work.is_done("more matches"):
            forget_pairs(self.work, self.copies, more)
            show = counter(self.progress, "matching again")
            match_pairs(self.work, self.copies, more, self.config, show, tolerant=True)
            self.work.set_done("more matches")
        if len(self.copies) <= AGAIN_LIMIT:
            models = self._map_again(models)
        elif not models:
            models = map_photos(self.work, len(self.copies), self.config, self.progress)
        if not models:
            return [], more
        main = self._third_pass(models[0])
        apart = replace(self, passes={})
        models = by_size([main, *apart.map_rest(main)])
        if models[0] is not main:
            self.passes = apart.passes
        return models, more

    def refine(self, model: Any) -> Any:
        """The refined model, with photos that only its points, of which there are more, give a pose."""
        refined = self._refined(model)
        if self.config.second_chance:
            self._drop_unsure(refined)
        if not self.config.second_chance or not self.missing(refined):
            return refined
        grown = self._place_by_points(refined, "second")
        self._drop_unsure(grown)
        return self._refined(grown) if names_of(grown) - names_of(refined) else refined

    def place_with_plain_lens(self, model: Any, names: Collection[str]) -> Any:
        """Registers photos whose lens had become implausible with the focal length of their matches to points.

        Their lenses have no distortion and stay as they are, because bundle adjustment made them implausible.

        Args:
            model: The model, without these photos.
            names: Names of their working copies.

        Returns:
            The model, with those of the photos for which a pose was found.
        """
        show = counter(self.progress, "matching to points")
        if not match_to_points(self.work, self.copies, self.vlads, model, self.config.seed, show, only=names):
            return model
        after = self._continue(model, "second", names)
        self._drop_unsure(after)
        return self._refined(after, lenses_of(self.work, names))

    def map_rest(self, main: Any) -> list[Any]:
        """Models of the photos that the main model leaves out.

        If more of them belong together than the main model has, that is a model of another place which happened to
        be found first. They are mapped alone, with several seeds, and with a second and third pass of their own.
        """
        rest = self.missing(main)
        if len(rest) < LEAST_GROUP:
            return []
        with open_database(self.work.database) as database:
            groups = find_groups(rest, verified_pairs(database, self.copies))
        largest = max(groups.values(), key=len)
        if len(largest) > main.num_reg_images():
            only = [self.copies[row] for row in sorted(largest)]
            models = map_repeatedly(self.work, self.copies, self.config, self.progress, only)
            if models:
                models[0] = self._third_pass(self._place_by_points(models[0], "second"))
            return models
        names = [self.copies[row].work_name for row in rest]
        return map_photos(self.work, len(self.copies), self.config, self.progress, names)

    def missing(self, model: Any) -> list[int]:
        """The photos without a pose in a model."""
        return missing_from(model, self.copies)

    def _drop_unsure(self, model: Any) -> None:
        names = {copy.work_name: copy.name for copy in self.copies}
        self.contradicted |= drop_unsure(model, self.work, self.passes, names)

    def _map_again(self, models: list[Any]) -> list[Any]:
        """Models by all matches, of which there are more now, if the largest one is better."""
        again = map_repeatedly(self.work, self.copies, self.config, self.progress)
        if not again or (models and not is_better(again[0], models[0], self.work)):
            return models
        self.passes.clear()
        return again

    def _third_pass(self, model: Any) -> Any:
        """Registers photos with fewer inliers, matches others to the points again, and drops unsure ones."""
        main = self._place_by_points(self._continue(model, "third"), "third")
        self._drop_unsure(main)
        return main

    def _place_by_points(self, model: Any, name: PassName) -> Any:
        """Registers further photos by matching them to the model's points, repeatedly."""
        show = counter(self.progress, "matching to points")
        for _ in range(POINT_ROUNDS):
            if not match_to_points(self.work, self.copies, self.vlads, model, self.config.seed, show):
                break
            before, model = model, self._continue(model, name)
            if model.num_reg_images() == before.num_reg_images():
                break
        return model

    def _continue(self, model: Any, name: PassName, constant_lenses: Collection[str] = ()) -> Any:
        """Registers further photos by the matches in the database, and notes the pass."""
        count = len(self.copies)
        after = continue_mapping(
            self.work, model, count, self.config, self.progress, constant_lenses=constant_lenses
        )
        for new in names_of(after) - names_of(model):
            self.passes.setdefault(new, name)
        return after

    def _refined(self, model: Any, constant: Collection[int] = ()) -> Any:
        refined = refine(
            self.work, model, len(self.copies), self.config, self.progress, self.guided, constant
        )
        return refined if keeps_agreement(model, refined, self.work.database) else model

    def _more_pairs(self, models: Sequence[Any]) -> set[Pair]:
        """Further pairs for photos without a pose, by retrieval and shared matches, of those that match poorly.

        Of few photos, others are matched again, too, because they have few matches as well, except those whose pose
        is due to their matches to points: matching photos does not find these.
        """
        kept = [photo for photo in range(len(self.copies)) if photo not in self.crops]
        missing = set(self.missing(models[0]) if models else kept) - self.crops
        by_points = {photo for photo in kept if self.copies[photo].work_name in self.passes}
        again = set(kept) - by_points if len(self.copies) <= AGAIN_LIMIT else missing
        with open_database(self.work.database) as database:
            matched = verified_pairs(database, self.copies)
        count = self.config.pairing.neighbours
        wanted = {row: count for row, photo in enumerate(kept) if photo in again}
        alike = {(kept[a], kept[b]) for a, b in alike_pairs(self.vlads[kept], wanted)}
        friends = friends_of_friends(again, matched, count)
        return {
            pair
            for pair in alike | friends
            if not set(pair) & self.crops
            and matched.get(pair, 0) < ENOUGH_MATCHES
            and (set(pair) & missing or not set(pair) & by_points)
        }
