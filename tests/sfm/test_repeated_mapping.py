from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import pytest

from wildgs.progress import silent
from wildgs.sfm import mapping_ahead, repeated_mapping
from wildgs.sfm.config import SfmConfig
from wildgs.sfm.upright import WorkingCopy
from wildgs.sfm.workplace import Workplace


@dataclass
class FakeModel:
    names: list[str]
    observations: int

    def compute_num_observations(self) -> int:
        return self.observations

    def num_reg_images(self) -> int:
        return len(self.names)

    def find_image_with_name(self, name: str) -> SimpleNamespace | None:
        return SimpleNamespace(has_pose=True) if name in self.names else None


@pytest.mark.parametrize(
    ("runs", "agreeing", "few", "best", "tried"),
    [
        ([["a", "b", "c"], ["a"]], 0.8, False, 0, 2),  # all photos have a pose, and most matches agree
        ([["a"], ["a", "b", "c"]], 0.8, False, 1, 2),
        ([["a", "b", "c"], ["a"], ["b"]], 0.6, False, 0, 3),
        ([["a"], ["a", "b"], []], 0.6, False, 1, 3),
        ([[], ["a"], []], 0.6, False, 1, 3),
        ([["a", "b", "c"], ["a"]], 0.8, True, 0, 2),
        ([["a", "b"], ["a", "b", "c"], ["a"], []], 0.6, True, 1, 4),
        ([[], [], [], []], 0.6, True, None, 4),
    ],
)
def test_mapping_is_repeated_while_photos_are_missing(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    runs: list[list[str]],
    agreeing: float,
    few: bool,
    best: int | None,
    tried: int,
) -> None:
    copies = [WorkingCopy(f"{name}.jpg", name, f"{name}.jpg", False) for name in "abc"]
    seeds = []

    def run(
        work: Workplace,
        count: int,
        config: SfmConfig,
        progress: object,
        only: Sequence[str],
        *,
        wide: bool,
        pair: tuple[int, int] | None,
    ) -> list[FakeModel]:
        assert list(only) == []
        assert wide == (len(seeds) % 3 == 1)
        assert pair == ((1, 2) if len(seeds) == 3 else None), "of few photos, initial pairs follow seeds"
        names = runs[len(seeds)]
        seeds.append(config.seed)
        return [FakeModel(names, 100 * len(names))] if names else []

    monkeypatch.setattr(mapping_ahead, "map_photos", run)
    monkeypatch.setattr(repeated_mapping, "initial_pairs", lambda *_: iter([(1, 2)]))
    monkeypatch.setattr(repeated_mapping, "PAIR_ATTEMPTS", 0)
    monkeypatch.setattr(repeated_mapping, "count_agreeing", lambda *_: (int(1000 * agreeing), 1000))
    monkeypatch.setattr(repeated_mapping, "is_wide", lambda model: True)
    monkeypatch.setattr(repeated_mapping, "FEW", 3 if few else 2)
    monkeypatch.setattr(repeated_mapping, "FEW_ATTEMPTS", 4)
    models = repeated_mapping.map_repeatedly(
        Workplace(tmp_path), copies, SfmConfig(seed=5, threads=1), silent
    )
    assert [model.names for model in models] == ([] if best is None else [runs[best]])
    assert seeds == [5, 6, 7, 8][:tried]


@pytest.mark.parametrize(
    ("agreeing", "distorted", "best"), [((400, 500), True, 1), ((0, 0), True, 0), ((400, 500), False, 0)]
)
def test_matches_that_agree_outweigh_points(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, agreeing: tuple[int, int], distorted: bool, best: int
) -> None:
    """The first run has more observations; the second expects strong distortion, and counts if it finds it."""
    monkeypatch.setattr(repeated_mapping, "is_wide", lambda model: distorted)
    copies = [WorkingCopy("a.jpg", "a", "a.jpg", False)]
    models, counts = iter([FakeModel(["a"], 900), FakeModel(["a"], 800)]), iter(agreeing)
    monkeypatch.setattr(repeated_mapping, "FEW_ATTEMPTS", 2)
    monkeypatch.setattr(mapping_ahead, "map_photos", lambda *_, **__: [next(models)])
    monkeypatch.setattr(repeated_mapping, "initial_pairs", lambda *_: iter(()))
    monkeypatch.setattr(repeated_mapping, "count_agreeing", lambda *_: (next(counts), 1000))
    found = repeated_mapping.map_repeatedly(Workplace(tmp_path), copies, SfmConfig(threads=1), silent)
    assert found[0].observations == (900, 800)[best]


@pytest.mark.parametrize(
    ("sizes", "share", "photos", "tried"),
    [
        ([2, 12, 11, 13, 14, 15, 16], 0.9, 15, 6),  # the best of five models that grew
        ([2, 3, 0, 12, 2], 0.9, 12, 5),
        ([9, 12, 12, 12, 12, 12, 12], 0.5, 12, 6),
        ([10, 12], 0.9, 10, 1),  # not stuck, and most matches agree
        ([10, 12, 3, 14], 0.5, 14, 4),  # too few agree
    ],
)
def test_other_initial_pairs_are_tried_where_a_model_does_not_grow_or_agree(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    sizes: list[int],
    share: float,
    photos: int,
    tried: int,
) -> None:
    copies = [WorkingCopy(f"{row}.jpg", f"{row}", f"{row}.jpg", False) for row in range(40)]
    pairs = [(row, row + 1) for row in range(len(sizes) - 1)]
    asked: list[tuple[int, int] | None] = []

    def run(*_: object, pair: tuple[int, int] | None, wide: bool = False) -> list[FakeModel]:
        asked.append(pair)
        size = sizes[0] if pair is None else sizes[1 + pair[0]]
        return [FakeModel([f"{row}" for row in range(size)], size)] if size else []

    monkeypatch.setattr(mapping_ahead, "map_photos", run)
    monkeypatch.setattr(repeated_mapping, "initial_pairs", lambda *_: iter(pairs))
    monkeypatch.setattr(repeated_mapping, "count_agreeing", lambda *_: (int(10 * share), 10))
    monkeypatch.setattr(repeated_mapping, "is_wide", lambda model: True)
    models = repeated_mapping.map_repeatedly(Workplace(tmp_path), copies, SfmConfig(threads=1), silent)
    assert models[0].num_reg_images() == photos
    assert asked == [None] * repeated_mapping.FIRST_ATTEMPTS + pairs[: tried - 1]


@pytest.mark.parametrize(("shares", "best"), [((0.6, 0.65), 1), ((0.6, 0.58), 0), ((0.6, 0.58, 0.61), 2)])
def test_other_pairs_have_to_be_more_exact_unless_the_model_is_stuck(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shares: tuple[float, ...], best: int
) -> None:
    """More photos with worse poses are not better: later passes find them as well."""
    copies = [WorkingCopy(f"{row}.jpg", f"{row}", f"{row}.jpg", False) for row in range(40)]
    pairs = [(row, row + 1) for row in range(len(shares) - 1)]

    def run(*_: object, pair: tuple[int, int] | None, wide: bool = False) -> list[FakeModel]:
        number = 0 if pair is None else 1 + pair[0]
        return [FakeModel([f"{row}" for row in range(30 + number)], number)]

    def agreeing(model: FakeModel, *_: object) -> tuple[int, int]:
        return int(100_000 * shares[model.observations]), 100_000

    monkeypatch.setattr(mapping_ahead, "map_photos", run)
    monkeypatch.setattr(repeated_mapping, "initial_pairs", lambda *_: iter(pairs))
    # More photos have more matches, too.
    monkeypatch.setattr(
        repeated_mapping, "_judge", lambda model, _: (len(model.names), agreeing(model)[0] / 100_000)
    )
    monkeypatch.setattr(repeated_mapping, "is_wide", lambda model: True)
    models = repeated_mapping.map_repeatedly(Workplace(tmp_path), copies, SfmConfig(threads=1), silent)
    assert models[0].observations == best


@pytest.mark.parametrize(("limit", "ahead"), [(3, True), (2, False)])
def test_many_photos_are_mapped_once_and_nothing_ahead(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: int, ahead: bool
) -> None:
    copies = [WorkingCopy(f"{name}.jpg", name, f"{name}.jpg", False) for name in "abc"]
    asked: list[bool] = []

    def each(*_: object, ahead: bool) -> Iterator[tuple[mapping_ahead.MappingRun, list[FakeModel]]]:
        asked.append(ahead)
        yield mapping_ahead.MappingRun(0), [FakeModel(["a", "b", "c"], 9)]

    monkeypatch.setattr(repeated_mapping, "map_each", each)
    monkeypatch.setattr(repeated_mapping, "ATTEMPTS_LIMIT", limit)
    monkeypatch.setattr(repeated_mapping, "FEW", 0)
    monkeypatch.setattr(repeated_mapping, "initial_pairs", lambda *_: iter(()))
    monkeypatch.setattr(repeated_mapping, "count_agreeing", lambda *_: (9, 10))
    models = repeated_mapping.map_repeatedly(Workplace(tmp_path), copies, SfmConfig(), silent)
    assert len(models) == 1
    assert asked == [ahead]
