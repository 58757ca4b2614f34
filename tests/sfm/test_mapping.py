from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import pytest

from wildgs.progress import silent
from wildgs.sfm import mapping
from wildgs.sfm.config import SfmConfig
from wildgs.sfm.upright import WorkingCopy
from wildgs.sfm.workplace import Workplace


@dataclass
class FakeModel:
    names: list[str]
    observations: int

    def compute_num_observations(self) -> int:
        return self.observations

    def find_image_with_name(self, name: str) -> SimpleNamespace | None:
        return SimpleNamespace(has_pose=True) if name in self.names else None


@pytest.mark.parametrize(
    ("runs", "best", "tried"),
    [
        ([["a", "b", "c"]], 0, 1),  # all photos have a pose
        ([["a"], ["a", "b", "c"]], 1, 2),
        ([["a"], ["a", "b"], []], 1, 3),
        ([[], ["a"], []], 1, 3),
    ],
)
def test_mapping_is_repeated_while_photos_are_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, runs: list[list[str]], best: int, tried: int
) -> None:
    copies = [WorkingCopy(f"{name}.jpg", name, f"{name}.jpg", False) for name in "abc"]
    seeds = []

    def run(
        work: Workplace, count: int, config: SfmConfig, progress: object, only: Sequence[str]
    ) -> list[FakeModel]:
        assert list(only) == []
        names = runs[len(seeds)]
        seeds.append(config.seed)
        return [FakeModel(names, 100 * len(names))] if names else []

    monkeypatch.setattr(mapping, "map_photos", run)
    models = mapping.map_repeatedly(Workplace(tmp_path), copies, SfmConfig(seed=5), silent)
    assert models[0].names == runs[best]
    assert seeds == [5, 6, 7][:tried]
